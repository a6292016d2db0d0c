"""Book covers and labels: paper, a motif, and lettering."""

import cv2
import numpy as np

from datagen.textures.noise import fractal_noise, lattice_noise
from datagen.textures.picture import Field, Picture, mix, shade, smoothstep

Colors = tuple[tuple[float, float, float], ...]

FONT = cv2.FONT_HERSHEY_TRIPLEX
PLAIN_FONT = cv2.FONT_HERSHEY_DUPLEX


def printed(
    rng: np.random.Generator,
    size: tuple[int, int],
    colors: Colors,
    *,
    text: tuple[str, ...] = (),
    motif: str | None = None,
    spine: float = 0.0,
) -> Picture:
    """Paint a label, or with a ``spine`` (its share of the width) a cover from back over spine to front."""
    width, height = size
    paper = np.broadcast_to(np.asarray(colors[0], np.float32), (height, width, 3)).copy()
    spine_width = round(width * spine)
    side = (width - spine_width) // 2
    front = paper[:, width - side :] if spine else paper
    _paint_front(rng, front, colors, text, motif)
    if spine:
        _paint_spine(paper[:, side : width - side], colors, text)
        _paint_back(rng, paper[:, :side], colors)
        hinge = np.abs(np.arange(width)[None, :] - np.array([[side], [width - side]])).min(axis=0)
        crease = 1 - smoothstep(0, width * 0.006, np.maximum(hinge - width * 0.01, 0))
        paper = shade(paper, (1 - 0.12 * crease)[None, :] * np.ones((height, 1), np.float32))
    clouds = fractal_noise(rng, size, (5, 5), octaves=5)
    return Picture(color=shade(paper, 1 + 0.04 * clouds), dullness=clouds)


def _paint_front(
    rng: np.random.Generator, page: Field, colors: Colors, text: tuple[str, ...], motif: str | None
) -> None:
    height, width = page.shape[:2]
    ink = colors[1]
    if motif is not None:
        top, bottom, left, right = round(height * 0.40), round(height * 0.88), round(width * 0.1), round(width * 0.9)
        page[top:bottom, left:right] = _MOTIFS[motif](rng, (right - left, bottom - top), colors)
    margin = round(0.045 * min(width, height))
    line = max(1, round(0.006 * min(width, height)))
    cv2.rectangle(page, (margin, margin), (width - margin - 1, height - margin - 1), ink, line, cv2.LINE_AA)
    places = (0.2, 0.32, 0.915) if motif is not None else (0.42, 0.62, 0.80)
    for i, words in enumerate(text[:3]):
        share = (0.76, 0.5, 0.4)[i]
        largest = ((0.10, 0.055, 0.04) if motif is not None else (0.24, 0.12, 0.09))[i]
        if motif is not None and i == 2:
            share = 0.3
        write(page, words, (width / 2, height * places[i]), width=width * share, largest=height * largest, color=ink)


def _paint_spine(page: Field, colors: Colors, text: tuple[str, ...]) -> None:
    height, width = page.shape[:2]
    band = colors[2] if len(colors) > 2 else colors[1]
    for share in (0.06, 0.9):
        page[round(height * share) : round(height * (share + 0.035))] = band
    if text:
        # Lettering runs down the spine: write it across and turn it.
        lying = np.ascontiguousarray(np.rot90(page, 1))
        write(lying, text[0], (height * 0.5, width * 0.5), width=height * 0.66, largest=width * 0.52, color=colors[1])
        page[:] = np.rot90(lying, -1)


def _paint_back(rng: np.random.Generator, page: Field, colors: Colors) -> None:
    """Paint lines that stand for the blurb, and a bar code."""
    height, width = page.shape[:2]
    ink = mix(colors[0], colors[1], np.full((1, 1), 0.7, np.float32))[0, 0].tolist()
    for row in range(9):
        y = round(height * (0.2 + 0.035 * row))
        end = width * (0.85 if row % 4 != 3 else rng.uniform(0.4, 0.7))
        cv2.line(page, (round(width * 0.15), y), (round(end), y), ink, max(1, round(height * 0.006)), cv2.LINE_AA)
    left, right, top, bottom = (round(v) for v in (width * 0.6, width * 0.86, height * 0.8, height * 0.92))
    page[top:bottom, left:right] = 0.93
    bars = np.repeat(rng.random(40) < 0.5, -(-(right - left) // 40))[: right - left]
    page[top + 4 : bottom - 4, left:right][:, bars] = 0.08


def write(
    page: Field, words: str, middle: tuple[float, float], *, width: float, largest: float, color: tuple[float, ...]
) -> None:
    """Letter ``words`` onto ``page`` around ``middle`` (x, y), at most ``width`` wide and ``largest`` high, pixels."""
    font = FONT if largest > 14 else PLAIN_FONT
    (wide, high), _ = cv2.getTextSize(words, font, 1.0, 2)
    scale = min(width / wide, largest / high)
    weight = max(1, round(scale * 1.7))
    (wide, high), _ = cv2.getTextSize(words, font, scale, weight)
    origin = (round(middle[0] - wide / 2), round(middle[1] + high / 2))
    cv2.putText(page, words, origin, font, scale, color, weight, cv2.LINE_AA)


def _landscape(size: tuple[int, int], colors: Colors) -> tuple[Field, Field, Field]:
    width, height = size
    across = ((np.arange(width) + 0.5) / width)[None, :].astype(np.float32) + np.zeros((height, 1), np.float32)
    down = ((np.arange(height) + 0.5) / height)[:, None].astype(np.float32) + np.zeros((1, width), np.float32)
    return across, down, np.broadcast_to(np.asarray(colors[0], np.float32), (height, width, 3))


def _sun(rng: np.random.Generator, size: tuple[int, int], colors: Colors) -> Field:
    """Paint a disc over hills."""
    across, down, page = _landscape(size, colors)
    aspect = size[0] / size[1]
    second = colors[min(2, len(colors) - 1)]
    color = mix(page, np.broadcast_to(np.asarray(second, np.float32), page.shape), 0.35 * down)
    disc = 1 - smoothstep(0.255, 0.262, np.hypot((across - 0.5) * aspect, down - 0.42))
    color = mix(color, np.broadcast_to(np.asarray(second, np.float32), page.shape), disc)
    for i, level in enumerate((0.62, 0.74, 0.87)):
        line = level + 0.07 * np.sin(2 * np.pi * (across * rng.uniform(0.8, 1.6) + rng.random()))
        line = line + 0.02 * lattice_noise(rng, (size[0], 1), (9, 1))
        hill = smoothstep(0, 0.006, down - line)
        tone = mix(
            page, np.broadcast_to(np.asarray(colors[1], np.float32), page.shape), np.full_like(down, 0.5 + 0.25 * i)
        )
        color = mix(color, tone, hill)
    return color


def _waves(rng: np.random.Generator, size: tuple[int, int], colors: Colors) -> Field:
    """Paint bands of waves."""
    across, down, page = _landscape(size, colors)
    second = np.broadcast_to(np.asarray(colors[min(2, len(colors) - 1)], np.float32), page.shape)
    ink = np.broadcast_to(np.asarray(colors[1], np.float32), page.shape)
    phase = rng.random()
    line = down * 9 + 0.35 * np.sin(2 * np.pi * (3 * across + phase + 0.5 * np.floor(down * 9)))
    stripe = smoothstep(0.42, 0.5, line % 1) * (1 - smoothstep(0.82, 0.9, line % 1))
    return mix(mix(page, second, 0.25 + 0.75 * down), ink, stripe * (0.35 + 0.5 * down))


def _leaves(rng: np.random.Generator, size: tuple[int, int], colors: Colors) -> Field:
    """Paint a branch with leaves."""
    width, height = size
    page = np.broadcast_to(np.asarray(colors[0], np.float32), (height, width, 3)).copy()
    leaf = colors[min(2, len(colors) - 1)]
    stem = np.array([[0.5 + 0.10 * np.sin(3 * t + rng.random() * 0.2), 1 - t] for t in np.linspace(0, 0.95, 30)])
    points = np.rint(stem * [width, height]).astype(np.int32)
    cv2.polylines(page, [points], isClosed=False, color=leaf, thickness=max(2, width // 90), lineType=cv2.LINE_AA)
    for i, (x, y) in enumerate(points[3::3]):
        side = 1 if i % 2 else -1
        length = width * (0.30 - 0.018 * i)
        angle = -90 + side * (62 - 2 * i)
        reach = np.radians(angle)
        middle = (round(x + 0.5 * length * np.cos(reach)), round(y + 0.5 * length * np.sin(reach)))
        cv2.ellipse(page, middle, (round(length / 2), round(length / 5.5)), angle, 0, 360, leaf, -1, cv2.LINE_AA)
        end = (round(x + 0.9 * length * np.cos(reach)), round(y + 0.9 * length * np.sin(reach)))
        cv2.line(page, (int(x), int(y)), end, colors[0], max(1, width // 200), cv2.LINE_AA)
    return page


def _bands(rng: np.random.Generator, size: tuple[int, int], colors: Colors) -> Field:
    """Paint slanting bands of different widths."""
    across, down, page = _landscape(size, colors)
    place = across * 0.7 + down
    color = page
    start = 0.1
    for i in range(6):
        wide = float(rng.uniform(0.06, 0.2))
        band = smoothstep(start, start + 0.006, place) * (1 - smoothstep(start + wide, start + wide + 0.006, place))
        tone = np.asarray(colors[1 + i % (len(colors) - 1)], np.float32)
        color = mix(color, np.broadcast_to(tone, page.shape), band)
        start += wide + float(rng.uniform(0.04, 0.12))
    return color


_MOTIFS = {"sun": _sun, "waves": _waves, "leaves": _leaves, "bands": _bands}
