"""The README's picture: plain Monte Carlo beside the control variate, after the same processor time.

Global illumination in scenes/interior.toml. Each half shows the same part of the image, brightened,
every pixel as 2 × 2. Run it in the checkout; it writes same_seconds.png and prints samples, seconds and
errors.
"""

import time

import numpy as np
import OpenImageIO as oiio

import ncv_cl as ncv

SCENE = ncv.load_scene("scenes/interior.toml")
SAMPLES = 64  # of the control variate, a point
EXPOSURE = 2.0
# The part that is shown, as fractions of height and width.
ROWS, COLUMNS = (0.5, 0.97), (0.5, 0.97)


def rendered(method: str, spp: int) -> tuple[ncv.Image, float]:
    """An image and the processor seconds, of all threads, that it took."""
    started = time.process_time()
    image = ncv.render(SCENE, "gi", method, spp=spp, size=(384, 384), seed=7)
    return image, time.process_time() - started


def part(image: ncv.Image) -> np.ndarray:
    """The shown part of an image as a screen shows it, float (rows, columns, 3)."""
    height, width = image.pixels.shape[:2]
    rows = slice(*(int(edge * height) for edge in ROWS))
    columns = slice(*(int(edge * width) for edge in COLUMNS))
    linear = np.clip(EXPOSURE * image.pixels[rows, columns], 0, 1)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return srgb.repeat(2, axis=0).repeat(2, axis=1)


# The first render of a kind compiles kernels; the second one counts.
for method in ("ncv", "mc"):
    rendered(method, SAMPLES)
control_variate, seconds = rendered("ncv", SAMPLES)
few, many = rendered("mc", SAMPLES)[1], rendered("mc", 2 * SAMPLES)[1]
affordable = SAMPLES * (1 + (seconds - few) / (many - few)) if many > few else SAMPLES
plain, plain_seconds = rendered("mc", max(2, round(affordable)))
for name, image, took in (("mc", plain, plain_seconds), ("ncv", control_variate, seconds)):
    samples, error = image.stats["samples_per_point"], image.stats["estimated_mse"]
    print(f"{name}: {samples:.0f} samples a point, {took:.1f} s, mean square error {error:.2e}")
left, right = part(plain), part(control_variate)
gap = np.ones((len(left), 6, 3))
strip = np.ascontiguousarray(np.concatenate([left, gap, right], axis=1), dtype=np.float32)
oiio.ImageBuf(strip).write("same_seconds.png", oiio.UINT8)
