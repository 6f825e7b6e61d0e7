"""A turntable of 24 frames with one training: the network of one view serves all others.

The network is a function of places in the scene, so it holds for other views as far as these see what
the first one saw; here the box turns to and fro before the camera. Each frame is unbiased whatever the
network knows. Run it in the checkout; it writes turntable_00.png and so on, and prints processor seconds
and errors, with those of frames that train a network each and of plain Monte Carlo.
"""

import math
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import ncv_cl as ncv

SCENE = ncv.load_scene("scenes/cornell_box.toml")
FRAMES, SWING, SIZE, SAMPLES = 24, 0.04, (96, 96), 128


def turned(turns: float) -> ncv.Scene:
    """The scene, the camera moved about the vertical axis through what it looks at."""
    camera = SCENE.camera
    position, target = np.array(camera.position), np.array(camera.target)
    x, y, z = position - target
    cosine, sine = math.cos(2 * math.pi * turns), math.sin(2 * math.pi * turns)
    offset = np.array([cosine * x + sine * z, y, cosine * z - sine * x])
    return replace(SCENE, camera=replace(camera, position=target + offset))


def frame(number: int, method: str = "ncv", **options: object) -> tuple[ncv.Image, float]:
    """A picture, and the processor seconds of all threads that it took."""
    scene = turned(SWING * math.sin(2 * math.pi * number / FRAMES))
    began = time.process_time()
    image = ncv.render(scene, "gi", method, spp=SAMPLES, size=SIZE, seed=number, **options)
    return image, time.process_time() - began


folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
network = folder / "turntable.npz"
# The first render of a kind compiles kernels; the second one counts.
runs = {}
for way in ({"method": "mc"}, {"method": "ncv"}, {"method": "ncv", "save_network": network}):
    frame(0, **way)
    runs[len(way), way["method"]] = frame(0, **way)
training = runs[2, "ncv"][1]
frames = [frame(number, network=network) for number in range(FRAMES)]
for number, (image, _) in enumerate(frames):
    image.write(folder / f"turntable_{number:02}.png")
each = {
    "one training": (frames[0][0], (training + sum(took for _, took in frames)) / FRAMES),
    "a training each": runs[1, "ncv"],
    "plain Monte Carlo": runs[1, "mc"],
}
for name, (image, took) in each.items():
    print(f"{name}: {took:.2f} s a frame, mean square error {image.stats['estimated_mse']:.2e}")
