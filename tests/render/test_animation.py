"""Animated PNG, read back by another decoder."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from prtbake_workers.render.animation import write_animation


def pictures(rng: np.random.Generator, count: int, height: int, width: int) -> list[np.ndarray]:
    return list(rng.integers(0, 256, (count, height, width, 3), dtype=np.uint8))


@pytest.mark.parametrize(
    ("size", "count"),
    # the last takes several data chunks a frame
    [((4, 5), 1), ((7, 3), 3), ((200, 300), 2)],
)
def test_every_frame_comes_back_with_its_delay(
    rng: np.random.Generator, tmp_path: Path, size: tuple[int, int], count: int
) -> None:
    frames = pictures(rng, count, *size)
    path = write_animation(tmp_path / "a.png", iter(frames), count, 15.0)
    with Image.open(path) as image:
        assert image.format == "PNG"
        assert getattr(image, "n_frames", 1) == count
        assert image.info["loop"] == 0
        for index, frame in enumerate(frames):
            image.seek(index)
            np.testing.assert_array_equal(np.asarray(image.convert("RGB")), frame)
            assert image.info["duration"] == pytest.approx(1000.0 / 15.0)
    # a viewer that knows no animations shows the first frame: so says the chunks' order
    data = path.read_bytes()
    assert data.index(b"acTL") < data.index(b"fcTL") < data.index(b"IDAT")


def test_frames_are_held_one_at_a_time(tmp_path: Path) -> None:
    side, count = 256, 20

    def frames():
        for index in range(count):
            yield np.full((side, side, 3), index, np.uint8)

    tracemalloc.start()
    write_animation(tmp_path / "a.png", frames(), count, 10.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # one frame and its copies; all of them would be 20
    assert peak < 5 * 3 * side**2


def test_what_the_file_says_must_be_true(rng: np.random.Generator, tmp_path: Path) -> None:
    frames = pictures(rng, 3, 4, 4)
    for said in (2, 4):
        with pytest.raises(ValueError, match=f"3 frames, not {said}"):
            write_animation(tmp_path / "a.png", frames, said, 10.0)
    with pytest.raises(ValueError, match="one at least"):
        write_animation(tmp_path / "a.png", [], 0, 10.0)
    with pytest.raises(ValueError, match="frame 1 is"):
        write_animation(tmp_path / "a.png", [frames[0], frames[1][:2]], 2, 10.0)
