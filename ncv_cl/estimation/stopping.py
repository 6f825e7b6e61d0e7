"""When a render has enough: its target, its time, or somebody asks it to end."""

from __future__ import annotations

import time

from ..host.clock import Run
from .image_estimate import ImageEstimate

# An error estimate is believed when so many samples of the image are to be expected on every light.
# They are then enough for each light's part of the error, which is a mean over the image; with less, a
# light that few samples go to may not have been seen at all.
FEWEST_ON_A_LIGHT = 4096


class ErrorTarget:
    """The mean square error that a render is to reach, and whether its estimate can be believed.

    Parameters
    ----------
    mse : float, optional
        None: never reached.
    narrowest : float
        Part of the square that the light with the least of it has, as `Problem` says.
    uniform_share : float
        Part of the samples that are spread over all of the square.
    """

    def __init__(self, mse: float | None, narrowest: float, uniform_share: float) -> None:
        self.mse = mse
        self._fewest = FEWEST_ON_A_LIGHT / (narrowest * uniform_share)

    def reached(self, image_estimate: ImageEstimate) -> bool:
        """Whether the error is the target or less, by an estimate of it that can be believed."""
        if self.mse is None or image_estimate.samples < self._fewest:
            return False
        # NaN, not known, is no such number.
        error = image_estimate.image_error()
        # Where nothing but zeros was found, what there is has not been found yet.
        return error <= self.mse and (error > 0.0 or image_estimate.finds_something())


class Stopping:
    """Asked after each pass whether there is to be another.

    Parameters
    ----------
    image_estimate : ImageEstimate
        Under way.
    target : ErrorTarget
    run : Run

    Attributes
    ----------
    ended_by : {"samples", "target_mse", "time_limit", "request"}
        Why there was none.
    """

    def __init__(self, image_estimate: ImageEstimate, target: ErrorTarget, run: Run) -> None:
        self._image_estimate, self._target, self._run = image_estimate, target, run
        self._began = time.perf_counter()
        self.ended_by = "samples"

    def enough(self, done: int) -> bool:
        """Whether the passes `done` are to be the last."""
        passes, now = self._image_estimate.passes, time.perf_counter()
        seconds, self._began = now - self._began, now
        if done == passes.number:
            return True
        # Passes are short where there is a limit, and their lengths differ a little.
        if seconds * passes.length(done) / passes.length(done - 1) > self._run.clock.left():
            self.ended_by = "time_limit"
        elif self._target.reached(self._image_estimate):
            self.ended_by = "target_mse"
        elif self._run.stop():
            self.ended_by = "request"
        return self.ended_by != "samples"
