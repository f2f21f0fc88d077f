"""``frontier.png``: error against seconds and against bytes, side by side, drawn with Pillow."""

from collections.abc import Callable, Mapping, Sequence
from io import BytesIO
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from prtbake_workers.report.html import percent, seconds, size
from prtbake_workers.report.log_axis import LogAxis

WIDTH, HEIGHT = 640, 440
"""Of a panel, in pixels."""
FINER = 3
"""Drawn so many times larger and reduced: lines and discs get smooth edges."""
LEFT, RIGHT, TOP, BOTTOM = 84, 20, 20, 56
RADIUS = 4
INK, GRID, POINT, FRONTIER = "#222222", "#dddddd", "#4a78c2", "#d1592a"
PANELS: Sequence[tuple[str, str, Callable[[int | float], str]]] = (
    ("seconds", "seconds of work", seconds),
    ("bytes", "bytes of the file", size),
)


def frontier_png(
    points: Sequence[Mapping[str, Any]], frontier: Mapping[str, Sequence[int]]
) -> bytes:
    """Draw the points of a study and its frontiers as PNG.

    Parameters
    ----------
    points
        Each with ``point`` (its number), ``error``, ``seconds`` and ``bytes``, and perhaps a
        ``label`` to stand beside it; those whose error is None are left out.
    frontier
        By cost, the numbers of its points by rising cost.
    """
    shown = [point for point in points if point["error"] is not None]
    picture = Image.new("RGB", (FINER * WIDTH * len(PANELS), FINER * HEIGHT), "white")
    draw = ImageDraw.Draw(picture)
    for place, (cost, label, write) in enumerate(PANELS):
        best = set(frontier[cost])
        line = [point for number in frontier[cost] for point in shown if point["point"] == number]
        _panel(draw, place * WIDTH, cost, label, write, shown, best, line)
    reduced = picture.resize((WIDTH * len(PANELS), HEIGHT), Image.Resampling.LANCZOS)
    file = BytesIO()
    reduced.save(file, "PNG", optimize=True)
    return file.getvalue()


def _panel(
    draw: ImageDraw.ImageDraw,
    left: int,
    cost: str,
    label: str,
    write: Callable[[int | float], str],
    points: Sequence[Mapping[str, Any]],
    best: set[int],
    line: Sequence[Mapping[str, Any]],
) -> None:
    font = ImageFont.load_default(FINER * 12)
    x = LogAxis.over([point[cost] for point in points], left + LEFT, left + WIDTH - RIGHT)
    y = LogAxis.over([point["error"] for point in points], HEIGHT - BOTTOM, TOP)

    def at(across: int | float, down: int | float) -> tuple[float, float]:
        return float(FINER * across), float(FINER * down)

    free = 0.0
    for tick in x.ticks():
        across = x.place(tick)
        draw.line([at(across, TOP), at(across, HEIGHT - BOTTOM)], GRID, FINER)
        half = draw.textlength(write(tick), font) / FINER / 2
        if across - half > free:  # words would run into each other
            draw.text(at(across, HEIGHT - BOTTOM + 14), write(tick), INK, font, anchor="mm")
            free = across + half
    for tick in y.ticks():
        down = y.place(tick)
        draw.line([at(left + LEFT, down), at(left + WIDTH - RIGHT, down)], GRID, FINER)
        draw.text(at(left + LEFT - 8, down), percent(tick), INK, font, anchor="rm")
    corners = [at(left + LEFT, TOP), at(left + WIDTH - RIGHT, HEIGHT - BOTTOM)]
    draw.rectangle(corners, outline=INK, width=FINER)
    middle = left + (LEFT + WIDTH - RIGHT) / 2
    draw.text(at(middle, HEIGHT - 14), f"error against {label}", INK, font, anchor="mm")

    def spot(point: Mapping[str, Any]) -> tuple[float, float]:
        return at(x.place(point[cost]), y.place(point["error"]))

    if len(line) > 1:
        draw.line([spot(point) for point in line], FRONTIER, 2 * FINER, joint="curve")
    # the frontier over the others
    for point in sorted(points, key=lambda point: point["point"] in best):
        on = point["point"] in best
        draw.circle(spot(point), FINER * (RADIUS + on), FRONTIER if on else POINT)
        if name := point.get("label"):
            across, down = x.place(point[cost]), y.place(point["error"])
            # within the panel: leftwards from points in its right half
            turned = across > middle
            place = at(across + (-12 if turned else 12), down)
            draw.text(place, name, INK, font, anchor="rm" if turned else "lm")
