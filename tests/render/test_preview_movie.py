"""The preview movie: a small film of the pictures that are there, as long as the whole."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from render.errors import InvalidFileError
from render.preview_movie import LARGEST_WIDTH, write_preview_movie

SIZE = (96, 64)
FRAMES = 12
WHITE, AMBER = (245, 245, 245), (255, 176, 48)
NEAR = 12  # levels: a lossy codec, twice, of plain areas


def draw(folder: Path, frames: list[int], *, size: tuple[int, int] = SIZE) -> dict[int, Path]:
    """Pictures that are brighter by 16 levels a frame."""
    folder.mkdir(exist_ok=True)
    pictures = {frame: folder / f"{frame:06d}.png" for frame in frames}
    for frame, path in pictures.items():
        Image.new("RGB", size, (16 * frame, 40, 200 - 16 * frame)).save(path)
    return pictures


def film_of(
    tmp_path: Path, pictures: dict[int, Path], *, frames: int = FRAMES, fps: float = 60.0
) -> tuple[list[np.ndarray], Path]:
    """The decoded frames, (height, width, 3), and their file."""
    copies, path = tmp_path / "copies", tmp_path / "so-far.mp4"
    copies.mkdir(exist_ok=True)
    write_preview_movie(pictures, frames, path, fps=fps, copies=copies)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert float(stream.average_rate) == fps
        decoded = [
            frame.reformat(format="rgb24", src_colorspace=1, dst_colorspace=1).to_ndarray().astype(int)
            for frame in container.decode(stream)
        ]
    return decoded, path


def shown(frame: np.ndarray) -> int:
    """Which picture a frame shows."""
    return round(float(frame[: SIZE[1] - 4, :, 0].mean()) / 16)


def test_a_frame_that_is_not_drawn_shows_the_nearest_one_before_it(tmp_path):
    decoded, _ = film_of(tmp_path, draw(tmp_path / "p", [2, 3, 7, 11]), fps=24.0)
    assert [shown(frame) for frame in decoded] == [2, 2, 2, 3, 3, 3, 3, 7, 7, 7, 7, 11]


def test_the_index_comes_before_the_pictures_so_that_players_begin_at_once(tmp_path):
    _, path = film_of(tmp_path, draw(tmp_path / "p", [0]))
    content = path.read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")


def test_a_strip_tells_what_is_drawn_and_whether_another_frame_stands_in(tmp_path):
    width, height, there = 384, 256, {0, 1, 2, 8}
    decoded, _ = film_of(tmp_path, draw(tmp_path / "p", sorted(there), size=(width, height)))
    of_a_frame = width // FRAMES
    for number, frame in enumerate(decoded):
        assert frame.shape == (height + 6, width, 3)
        strip = frame[height + 2 : -2].mean(axis=0)
        mark = strip[number * of_a_frame + 15 : number * of_a_frame + 17].mean(axis=0)
        np.testing.assert_allclose(
            mark, WHITE if number in there else AMBER, atol=3 * NEAR
        )  # four pixels wide, of two of colour
        for other in set(range(FRAMES)) - {number}:
            stretch = strip[other * of_a_frame + 8 : other * of_a_frame + 24].mean()
            assert stretch == pytest.approx(157 if other in there else 47, abs=NEAR), (number, other)


def test_a_film_of_more_frames_than_pixels_shows_how_much_of_each_stretch_is_drawn(tmp_path):
    every_second = list(range(0, 192, 2))
    pictures = draw(tmp_path / "p", [0])
    decoded, _ = film_of(tmp_path, dict.fromkeys(every_second, pictures[0]), frames=384)
    assert len(decoded) == 384
    strip = decoded[-1][SIZE[1] + 1 : -1].mean(axis=(0, 2))
    np.testing.assert_allclose(strip[4:44], (47 + 157) / 2, atol=NEAR)
    np.testing.assert_allclose(strip[52:88], 47, atol=NEAR)


@pytest.mark.parametrize(
    ("size", "expected"), [((1281, 723), (LARGEST_WIDTH, 362)), ((97, 65), (98, 66)), ((96, 64), (96, 64))]
)
def test_pictures_are_made_smaller_but_never_larger_than_they_are(tmp_path, size, expected):
    decoded, _ = film_of(tmp_path, draw(tmp_path / "p", [5], size=size), frames=7)
    height, width, _ = decoded[0].shape
    assert width == expected[0]
    assert expected[1] < height <= expected[1] + expected[1] // 45 + 4


def test_no_picture_is_read_twice(tmp_path):
    pictures = draw(tmp_path / "p", [0, 6])
    film_of(tmp_path, pictures)
    for path in pictures.values():
        path.unlink()
    decoded, _ = film_of(tmp_path, {**pictures, **draw(tmp_path / "p", [9])})
    assert [shown(decoded[frame]) for frame in (0, 5, 6, 9, 11)] == [0, 0, 6, 9, 9]


def test_a_damaged_picture_is_named(tmp_path):
    pictures = draw(tmp_path / "p", [0, 1])
    pictures[1].write_bytes(pictures[1].read_bytes()[:-20])
    with pytest.raises(InvalidFileError, match=r"000001\.png: is truncated"):
        film_of(tmp_path, pictures)


@pytest.mark.parametrize("frames", [[], [12], [-1, 3]])
def test_frames_that_the_film_does_not_have_are_refused(tmp_path, frames):
    with pytest.raises(ValueError, match="a film of 12 frames cannot be shown by pictures of the frames"):
        film_of(tmp_path, dict.fromkeys(frames, tmp_path))
