"""What tests of executors share: pictures by workers, executors that fail, and functions that travel."""

from __future__ import annotations

import threading
from concurrent.futures import Executor, Future, ThreadPoolExecutor

import numpy as np
from processes import ROOT

import ncv_cl as ncv

SCENES = ROOT / "scenes"
SMALL = {"spp": 160, "size": (24, 20), "seed": 5, "train_spp": 8}
# A scene, an integrand and options; more than one step of passes where direct light is apart.
CASES = {
    "ao by slices": ("knot", "ao", {"method": "mc", "visibility": "lines"}),
    "ao by rays": ("cornell_box", "ao", {"method": "ncv", "visibility": "points"}),
    "direct": ("cornell_box", "direct", {"method": "mc"}),
    "direct, independent": ("occluders", "direct", {"method": "mc", "sampler": "independent"}),
    "direct, pilot": ("occluders", "direct", {"method": "mc", "allocation": "pilot", "supersample": 2}),
    "direct, dark points": ("cornell_box", "direct", {"method": "mc", "skip_dark": False}),
    "direct, network": ("cornell_box", "direct", {"method": "ncv", "allocation": "relative"}),
    "direct, triangles": ("occluders", "direct", {"method": "ncv", "density": "subdivision"}),
    "direct, slides": ("cornell_box", "direct", {"method": "ncv", "preset": "slides"}),
    "gi": ("cornell_box", "gi", {"method": "mc"}),
    "gi, network": ("interior", "gi", {"method": "ncv"}),
    "gi, not apart": ("interior", "gi", {"method": "mc", "split_direct": "off", "spp": 320}),
    "gi, to an error": ("cornell_box", "gi", {"method": "mc", "target_mse": 1e-9}),
}


def picture(case: str, **options: object) -> ncv.Image:
    """The picture of a case, by workers if there is an executor among the options."""
    scene, integrand, own = CASES[case]
    chosen = {**SMALL, **own, **options}
    if chosen["method"] == "mc":
        del chosen["train_spp"]
    if "executor" in chosen:
        chosen.setdefault("task_points", 130)
    return ncv.render(SCENES / f"{scene}.toml", integrand, **chosen)


def disc(u: np.ndarray, v: np.ndarray, point: np.ndarray) -> np.ndarray:
    """A function that travels by its name."""
    return np.hypot(u - 0.5, v - 0.5) < 0.1 + 0.4 * point / 300


class Failing(Executor):
    """Threads, but that `meddle` is asked of each task first, which says what becomes of it.

    Parameters
    ----------
    meddle : callable
        Given the task's number from 0 on: None, an exception that it ends with, or "hang".
    """

    def __init__(self, meddle) -> None:
        self._pool, self._meddle = ThreadPoolExecutor(2), meddle
        self._lock = threading.Lock()
        self.number = 0

    def submit(self, function, /, *arguments, **options) -> Future:
        with self._lock:
            number, self.number = self.number, self.number + 1
        what = self._meddle(number)
        if what is None:
            return self._pool.submit(function, *arguments, **options)
        future: Future = Future()
        if isinstance(what, BaseException):
            future.set_exception(what)
        else:
            future.set_running_or_notify_cancel()
        return future
