"""Contact sheets: every frame in its place, with its number."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from render.sheet import contact_sheet, frame_label

COLORS = [(200, 0, 0), (0, 200, 0), (0, 0, 200), (200, 200, 0), (0, 200, 200)]


@pytest.fixture
def pictures(tmp_path):
    paths = []
    for index, color in enumerate(COLORS):
        paths.append(tmp_path / f"{index:06d}.png")
        Image.new("RGB", (64, 36), color).save(paths[-1])
    return paths


def test_frames_stand_row_by_row(tmp_path, pictures):
    contact_sheet(pictures, tmp_path / "sheet.png", columns=2, width=108)
    sheet = np.asarray(Image.open(tmp_path / "sheet.png"))
    # Two cells of 48 pixels and three gaps of 4; a cell is 48 * 36 / 64 = 27 pixels high; three rows.
    assert sheet.shape == (3 * 31 + 4, 108, 3)
    for index, color in enumerate(COLORS):
        row, column = divmod(index, 2)
        middle = sheet[4 + 31 * row + 10, 4 + 52 * column + 40]
        np.testing.assert_array_equal(middle, color)
    np.testing.assert_array_equal(sheet[80, 80], sheet[0, 0])  # the last cell stays empty


def test_small_frames_stand_without_gaps_between_them(tmp_path, pictures):
    contact_sheet(pictures[:4], tmp_path / "sheet.png", columns=2, width=1440)
    sheet = np.asarray(Image.open(tmp_path / "sheet.png"))
    assert sheet.shape == (2 * 40 + 4, 2 * 68 + 4, 3)
    for index, color in enumerate(COLORS[:4]):
        row, column = divmod(index, 2)
        np.testing.assert_array_equal(sheet[4 + 40 * row + 1, 4 + 68 * column + 62], color)


def test_frames_carry_their_labels(tmp_path, pictures):
    contact_sheet(pictures[:1], tmp_path / "one.png", columns=1, width=200)
    other = pictures[0].rename(tmp_path / "000007.png")
    contact_sheet([other], tmp_path / "two.png", columns=1, width=200)
    one, two = (np.asarray(Image.open(tmp_path / name)) for name in ("one.png", "two.png"))
    assert (one != COLORS[0]).any()
    assert (one != two).any()


def test_labels_are_frame_numbers(tmp_path):
    assert frame_label(tmp_path / "000042.png") == "42"
    assert frame_label(tmp_path / "before.png") == "before"


def test_impossible_sheets_are_refused(tmp_path, pictures):
    with pytest.raises(ValueError, match="at least one picture"):
        contact_sheet([], tmp_path / "sheet.png")
    with pytest.raises(ValueError, match="5 columns do not fit into 40 pixels"):
        contact_sheet(pictures, tmp_path / "sheet.png", columns=5, width=40)
