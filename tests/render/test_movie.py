"""Films: colours, timestamps, independence of segments, and damaged files."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from render import movie
from render.errors import InvalidFileError
from render.movie import encode_segment, frame_rate, join_segments, missing_encoder, validate_movie
from render.parameters import MovieParameters

PARAMETERS = MovieParameters(preset="veryfast")


def picture(path: Path, index: int, size: tuple[int, int] = (64, 48)) -> Path:
    """A bright square that moves over a gradient; noise keeps the encoder from skipping anything."""
    width, height = size
    pixels = np.random.default_rng(index).integers(0, 40, (height, width, 3)).astype(np.uint8)
    pixels[..., 1] += np.linspace(0, 200, width).astype(np.uint8)
    pixels[10:20, (3 * index) % (width - 10) : (3 * index) % (width - 10) + 10] = 255
    Image.fromarray(pixels).save(path)
    return path


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("frames")
    return [picture(folder / f"{index:06d}.png", index) for index in range(62)]


def encode(path: Path, pictures: list[Path], fps: float = 60, **changes) -> Path:
    encode_segment(pictures, path, fps=fps, **{"parameters": PARAMETERS, "threads": 1, **changes})
    return path


def encode_all(folder: Path, pictures: list[Path], fps: float = 60) -> list[Path]:
    starts = range(0, len(pictures), 30)
    return [encode(folder / f"{start:04d}.mp4", pictures[start : start + 30], fps) for start in starts]


def luma_of(path: Path) -> np.ndarray:
    """Luma of a film's first frame in its own bits, (height, width)."""
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
        plane = frame.planes[0]
        values = np.frombuffer(plane, np.uint16 if "10" in frame.format.name else np.uint8)
        return values.reshape(frame.height, -1)[:, : frame.width].astype(int)


def decode(path: Path) -> tuple[list[np.ndarray], list[Fraction]]:
    with av.open(str(path)) as container:
        frames = [(frame.to_ndarray(), frame.pts * frame.time_base) for frame in container.decode(video=0)]
    planes, times = zip(*frames, strict=True)
    return list(planes), list(times)


@pytest.mark.parametrize("fps", [24, 23.976, 7.3, 0.01])  # 60 below, with each codec
def test_the_film_shows_the_segments_frames_at_exact_times(tmp_path, pictures, fps):
    segments = encode_all(tmp_path, pictures, fps)
    film = tmp_path / "film.mp4"
    join_segments(segments, film)
    validate_movie(film, 62)
    frames, times = decode(film)
    assert times == [index / frame_rate(fps) for index in range(62)]
    expected = [frame for segment in segments for frame in decode(segment)[0]]
    np.testing.assert_array_equal(frames, expected)


def test_the_film_looks_like_its_pictures(tmp_path, pictures):
    planes, _ = decode(encode(tmp_path / "segment.mp4", pictures[:10], parameters=MovieParameters(crf=8)))
    for plane, path in zip(planes, pictures, strict=False):
        luma = 16 + 219 / 255 * np.asarray(Image.open(path)) @ np.array([0.2126, 0.7152, 0.0722])
        difference = plane[:48, :64] - luma
        assert abs(difference.mean()) < 0.5  # rounding has no bias; a wrong range would shift by up to 16
        assert np.sqrt((difference**2).mean()) < 3.0  # crf 8 quantizes the noise in steps of a few levels


CODECS = ("h264", "h265", "av1", "prores")


def codec_parameters(codec: str) -> MovieParameters:
    return MovieParameters(codec=codec) if codec == "prores" else MovieParameters(codec=codec, preset="veryfast")


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize(
    ("color", "eight_bits", "ten_bits"),
    # Y' = 16 + 219 (0.2126 R' + 0.7152 G' + 0.0722 B') after ITU-R BT.709-6; BT.601 would give 81, 145, 41. In 10 bits
    # it is 64 + 876 (...): red 250.2, green 690.5.
    [
        ((255, 0, 0), 63, 250),
        ((0, 255, 0), 173, 691),
        ((0, 0, 255), 32, 127),
        ((255, 255, 255), 235, 940),
        ((0, 0, 0), 16, 64),
    ],
)
def test_colours_are_converted_by_bt709(tmp_path, codec, color, eight_bits, ten_bits):
    plain = tmp_path / "000000.png"
    Image.new("RGB", (64, 64), color).save(plain)
    parameters = codec_parameters(codec)
    shown = luma_of(encode(tmp_path / f"film{parameters.suffix}", [plain], parameters=parameters))
    # A lossy encoder may miss a plain area by one level of 1023.
    luma, error = (eight_bits, 0) if codec == "h264" else (ten_bits, 1)
    assert abs(shown - luma).max() <= error


@pytest.mark.parametrize("codec", CODECS)
def test_films_are_joined_tagged_and_reproducible(tmp_path, pictures, codec):
    parameters = codec_parameters(codec)
    segments = [
        encode(tmp_path / f"{start}{parameters.suffix}", pictures[start : start + 30], parameters=parameters)
        for start in (0, 30, 60)
    ]
    film = tmp_path / f"film{parameters.suffix}"
    join_segments(segments, film)
    validate_movie(film, 62)
    frames, times = decode(film)
    assert times == [Fraction(index, 60) for index in range(62)]
    expected = [frame for segment in segments for frame in decode(segment)[0]]
    np.testing.assert_array_equal(frames, expected)
    with av.open(str(film)) as container:
        context = container.streams.video[0].codec_context
        frame = next(container.decode(video=0))
        for tagged in (context, frame):
            tags = (tagged.color_primaries, tagged.color_trc, tagged.colorspace, tagged.color_range)
            assert tags == (1, 1, 1, 1)  # BT.709 three times, and MPEG (limited) range
        tag, layout = {
            "h264": ("avc1", "yuv420p"),
            "h265": ("hvc1", "yuv420p10le"),
            "av1": ("av01", "yuv420p10le"),
            "prores": ("apch", "yuv422p10le"),
        }[codec]
        assert (context.codec_tag, context.pix_fmt) == (tag, layout)
    threads = 1 if codec == "h264" else 2
    again = encode(tmp_path / f"again{parameters.suffix}", pictures[:30], parameters=parameters, threads=threads)
    assert again.read_bytes() == segments[0].read_bytes()
    for expected in (61, 63):
        with pytest.raises(InvalidFileError, match=f"has 62 frames, expected {expected}"):
            validate_movie(film, expected)


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("lengths", [(1,), (2, 30), (30, 1), (1, 2, 3)])
def test_short_segments_join(tmp_path, pictures, codec, lengths):
    """One or two frames have no B-frames, so their decoding order starts elsewhere."""
    parameters = codec_parameters(codec)
    segments = [
        encode(tmp_path / f"{index}{parameters.suffix}", pictures[:length], parameters=parameters)
        for index, length in enumerate(lengths)
    ]
    film = tmp_path / f"film{parameters.suffix}"
    join_segments(segments, film)
    validate_movie(film, sum(lengths))
    assert decode(film)[1] == [Fraction(index, 60) for index in range(sum(lengths))]


def test_ten_bits_of_a_deep_picture_reach_the_film(tmp_path):
    """A ramp of 16 bits between two neighbouring levels of 8: a film of 8 bits has a step where this one has four."""
    row = np.linspace(100 * 257, 102 * 257, 64).round().astype(np.uint16)
    frame = av.VideoFrame.from_ndarray(np.repeat(np.tile(row, (64, 1))[..., None], 3, axis=2), format="rgb48le")
    encoder = av.CodecContext.create("png", "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.time_base = 64, 64, "rgb48be", Fraction(1, 60)
    packets = [*encoder.encode(frame.reformat(format="rgb48be")), *encoder.encode(None)]
    (tmp_path / "000000.png").write_bytes(b"".join(bytes(packet) for packet in packets))
    film = encode(tmp_path / "film.mov", [tmp_path / "000000.png"], parameters=MovieParameters(codec="prores"))
    assert len(np.unique(luma_of(film).mean(axis=0).round())) >= 6


def test_an_unknown_encoder_is_named(monkeypatch):
    assert missing_encoder("av1") is None
    monkeypatch.setitem(movie._ENCODERS, "av1", movie._ENCODERS["av1"]._replace(name="libno_such_encoder"))
    assert missing_encoder("av1") == "libno_such_encoder"


def test_the_index_stands_in_front_of_the_pictures(tmp_path, pictures):
    film = tmp_path / "film.mp4"
    join_segments(encode_all(tmp_path, pictures[:32]), film)
    content = film.read_bytes()
    assert 0 < content.find(b"moov") < content.find(b"mdat")


def test_two_encodes_give_equal_bytes(tmp_path, pictures):
    first = encode(tmp_path / "first.mp4", pictures[:30]).read_bytes()
    for seed in range(8):
        # Freed memory with other content: an encoder that reads what it did not write betrays itself.
        leftovers = [np.full(size, seed, np.uint8) for size in range(1000, 300_000, 10_000)]
        del leftovers
        assert encode(tmp_path / "second.mp4", pictures[:30]).read_bytes() == first
    join_segments([tmp_path / "first.mp4", tmp_path / "second.mp4"], tmp_path / "film.mp4")
    join_segments([tmp_path / "first.mp4", tmp_path / "second.mp4"], tmp_path / "again.mp4")
    assert (tmp_path / "film.mp4").read_bytes() == (tmp_path / "again.mp4").read_bytes()


def test_a_changed_frame_changes_only_its_segment(tmp_path, pictures):
    before = [path.read_bytes() for path in encode_all(tmp_path, pictures)]
    changed = [*pictures]
    changed[35] = picture(tmp_path / "000035.png", 99)
    after = [path.read_bytes() for path in encode_all(tmp_path, changed)]
    assert [old == new for old, new in zip(before, after, strict=True)] == [True, False, True]


@pytest.mark.parametrize("size", [(63, 48), (64, 47)])
def test_odd_sizes_are_refused(tmp_path, size):
    odd = picture(tmp_path / "000000.png", 0, size)
    with pytest.raises(InvalidFileError, match=f"is {size[0]}x{size[1]} pixels, but H.264 needs an even"):
        encode(tmp_path / "segment.mp4", [odd])


def test_pictures_of_two_sizes_are_refused(tmp_path, pictures):
    other = picture(tmp_path / "000001.png", 0, (32, 32))
    with pytest.raises(InvalidFileError, match=r"000001\.png: is 32x32 pixels, but 000000\.png is 64x48"):
        encode(tmp_path / "segment.mp4", [pictures[0], other])


def test_segments_of_two_encodings_are_refused(tmp_path, pictures):
    one = encode(tmp_path / "one.mp4", pictures[:3])
    other = encode(tmp_path / "other.mp4", pictures[:3], fps=24)
    with pytest.raises(InvalidFileError, match=r"other\.mp4: was not encoded as .*one\.mp4"):
        join_segments([one, other], tmp_path / "film.mp4")


@pytest.mark.parametrize("kept", [0.0, 0.01, 0.3, 0.7, 0.99])
def test_a_truncated_film_is_refused(tmp_path, pictures, kept):
    film = encode(tmp_path / "film.mp4", pictures[:30])
    content = film.read_bytes()
    film.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(InvalidFileError):
        validate_movie(film, 30)


def test_nothing_to_encode_or_join_is_refused(tmp_path):
    with pytest.raises(ValueError, match="at least one picture"):
        encode(tmp_path / "segment.mp4", [])
    with pytest.raises(ValueError, match="at least one segment"):
        join_segments([], tmp_path / "film.mp4")


def test_a_missing_segment_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"missing\.mp4"):
        join_segments([tmp_path / "missing.mp4"], tmp_path / "film.mp4")
