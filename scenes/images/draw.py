"""Draws the images of scenes/textured_room.toml: python scenes/images/draw.py [FOLDER]"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

SIZE = 128


def noise(generator: np.random.Generator, cells_x: int, cells_y: int) -> np.ndarray:
    """Smooth noise in [0, 1] that goes on beyond the sides, (SIZE, SIZE)."""
    total = np.zeros((SIZE, SIZE))
    for octave in range(4):
        nx, ny = min(cells_x << octave, SIZE), min(cells_y << octave, SIZE)
        values = generator.random((ny, nx))
        x, y = np.arange(SIZE) / SIZE * nx, np.arange(SIZE) / SIZE * ny
        i, j = x.astype(int), y.astype(int)
        share_x, share_y = ((3 - 2 * t) * t * t for t in (x - i, y - j))
        rows = values[j][:, i] * (1 - share_x) + values[j][:, (i + 1) % nx] * share_x
        below = values[(j + 1) % ny]
        others = below[:, i] * (1 - share_x) + below[:, (i + 1) % nx] * share_x
        total += (rows * (1 - share_y)[:, None] + others * share_y[:, None]) / 2**octave
    return total / 1.875


def coloured(values: np.ndarray, dark: tuple[float, ...], bright: tuple[float, ...]) -> np.ndarray:
    return np.array(dark) + values[..., None] * (np.array(bright) - np.array(dark))


def wood(generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Planks along x, and how rough they are."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    plank = (y * 4).astype(int)
    grain = noise(generator, 2, 24)
    rings = 0.5 + 0.5 * np.sin(40 * (y + 0.1 * noise(generator, 3, 3)) + 7 * plank)
    tone = np.array([0.1, -0.12, 0.04, -0.03])[plank]
    colour = coloured(0.55 * grain + 0.35 * rings + tone, (0.36, 0.22, 0.12), (0.76, 0.54, 0.34))
    joint = (np.abs(y * 4 % 1 - 0.5) > 0.485) | (np.abs((x + 0.37 * plank) % 1 - 0.5) < 0.006)
    colour[joint] *= 0.35
    return colour, np.where(joint, 0.9, 0.25 + 0.35 * grain)


def brick(generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Bricks in mortar, and their normals."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    row = (y * 8).astype(int)
    along = x * 4 + 0.5 * (row % 2)
    mortar = (np.abs(along % 1 - 0.5) > 0.47) | (np.abs(y * 8 % 1 - 0.5) > 0.44)
    tone = generator.random((8, 4))[row, along.astype(int) % 4]
    grain = noise(generator, 16, 16)
    colour = coloured(0.5 * tone + 0.5 * grain, (0.42, 0.17, 0.12), (0.80, 0.42, 0.30))
    colour = np.where(mortar[..., None], coloured(grain, (0.6, 0.58, 0.54), (0.78, 0.76, 0.7)), colour)
    height = 1.6 * ~mortar + 0.8 * grain
    # Slopes along u, which is x, and v, which goes upwards.
    slope_x = np.roll(height, -1, axis=1) - np.roll(height, 1, axis=1)
    slope_y = np.roll(height, 1, axis=0) - np.roll(height, -1, axis=0)
    normal = np.stack([-0.5 * slope_x, -0.5 * slope_y, np.ones_like(height)], axis=-1)
    return colour, 0.5 + 0.5 * normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def paper(generator: np.random.Generator) -> np.ndarray:
    """Wallpaper: stripes with leaves."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    stripes = np.where((x * 4).astype(int) % 2 == 0, 0.72, 0.78)
    colour = stripes[..., None] * np.array([0.98, 1.0, 0.92])
    for centre_x, centre_y, turn in ((0.125, 0.25, 1), (0.625, 0.75, -1)):
        dx, dy = x - centre_x, y - centre_y
        for side in (-1, 1):
            u = (dx * side + turn * 0.3 * dy) * 9 - 0.35
            leaf = np.hypot(u / 0.5, (dy + 0.25 * dx * side) * 7) < 0.7
            colour[leaf] = (0.35, 0.5, 0.38)
        colour[np.hypot(dx, dy) < 0.035] = (0.75, 0.35, 0.3)
    return colour * (0.96 + 0.06 * noise(generator, 32, 32)[..., None])


def painting(generator: np.random.Generator) -> np.ndarray:
    """Hills under an evening sky, in a gilded frame."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    colour = coloured(y, (0.30, 0.42, 0.70), (0.98, 0.72, 0.42))
    colour[np.hypot(x - 0.68, y - 0.46) < 0.07] = (1.0, 0.93, 0.75)
    for depth, (dark, bright) in enumerate(
        [((0.36, 0.34, 0.50), (0.46, 0.42, 0.55)), ((0.22, 0.34, 0.30), (0.33, 0.45, 0.33)),
         ((0.10, 0.20, 0.12), (0.24, 0.36, 0.16))]
    ):  # fmt: skip
        hill = 0.52 + 0.14 * depth + 0.09 * np.sin(5 * x + 2.3 * depth) + 0.03 * np.sin(17 * x + depth)
        below = y > hill
        colour[below] = coloured(noise(generator, 8, 8), dark, bright)[below]
    frame = np.maximum(np.abs(x - 0.5), np.abs(y - 0.5)) > 0.44
    colour[frame] = coloured(0.5 + 0.5 * np.sin(90 * (x + y)), (0.45, 0.33, 0.12), (0.85, 0.68, 0.3))[
        frame
    ]
    return colour


def leaf() -> np.ndarray:
    """A stalk with leaves on both sides, and nothing around them."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    across, up = x - 0.5, 1 - y
    shown = np.abs(across) < 0.012
    shade = np.full((SIZE, SIZE), 0.2)
    for number in range(7):
        side, start = (-1) ** number, 0.12 + 0.12 * number
        along = across * side * 0.85 + (up - start) * 0.53
        off = (up - start) * 0.85 - across * side * 0.53
        length = 0.42 - 0.025 * number
        inside = (along > 0) & (along < length)
        width = 0.09 * np.sin(np.pi * np.clip(along / length, 0, 1)) ** 0.8
        blade = inside & (np.abs(off) < width)
        shade[blade] = (0.45 + 0.5 * along + 0.3 * (np.abs(off) < 0.006))[blade]
        shown |= blade
    return np.concatenate(
        [coloured(shade, (0.06, 0.22, 0.05), (0.45, 0.75, 0.3)), shown[..., None]], axis=-1
    )


def write(path: Path, pixels: np.ndarray) -> None:
    """An 8-bit PNG of values in [0, 1], of one channel, three or four."""
    rows = pixels if pixels.ndim == 3 else pixels[..., None]
    stored = np.round(255 * np.clip(rows, 0, 1)).astype(np.uint8)
    output = oiio.ImageOutput.create(str(path))
    spec = oiio.ImageSpec(SIZE, SIZE, stored.shape[2], "uint8")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    output.open(str(path), spec)
    output.write_image(np.ascontiguousarray(stored))
    output.close()


def main(folder: Path) -> None:
    generator = np.random.default_rng(1886)
    colour, rough = wood(generator)
    bricks, normals = brick(generator)
    images = {"wood": colour, "wood_roughness": rough, "brick": bricks, "brick_normals": normals}
    images |= {"leaf": leaf(), "paper": paper(generator), "painting": painting(generator)}
    for name, pixels in images.items():
        write(folder / f"{name}.png", pixels)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
