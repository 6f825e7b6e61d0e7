"""When a render ends before its samples are drawn: error reached, time over, or asked to stop."""

from __future__ import annotations

import time

from ..host.clock import Run
from .direct import DirectEstimate
from .image_estimate import ImageEstimate

# An error estimate is believed only when every light is expected to have got this many of the image's
# samples. With fewer, a light that few samples go to may have been missed altogether, and with it its
# part of the error.
FEWEST_ON_A_LIGHT = 4096


class ErrorTarget:
    """The mean square error that a render is to reach, and whether its estimate can be believed.

    Parameters
    ----------
    mse : float, optional
        None: never reached.
    narrowest : float
        Width of the narrowest light's strip of the square (`Problem.narrowest`).
    uniform_share : float
        Part of the samples that are uniform over the square.
    """

    def __init__(self, mse: float | None, narrowest: float, uniform_share: float) -> None:
        self.mse = mse
        self._fewest_uniform = FEWEST_ON_A_LIGHT / narrowest
        self._fewest = self._fewest_uniform / uniform_share

    def reached(self, image_estimate: ImageEstimate, direct: DirectEstimate | None = None) -> bool:
        """Whether a credible estimate of the error, with that of direct light, is at most the target."""
        if self.mse is None or image_estimate.samples < self._fewest:
            return False
        # The error is NaN where it is not known: then it is not reached.
        error = image_estimate.image_error()
        if direct is not None:
            if direct.samples < self._fewest_uniform:
                return False
            error += direct.image_error()
        # An image of nothing but zeros has an error of 0, because no light was found yet.
        return error <= self.mse and (error > 0.0 or image_estimate.finds_something())


class Stopping:
    """Asked after each pass whether there is to be another.

    Parameters
    ----------
    image_estimate : ImageEstimate
        Under way.
    target : ErrorTarget
    run : Run
    direct : DirectEstimate, optional
        What else the image is the sum of.

    Attributes
    ----------
    ended_by : {"samples", "target_mse", "time_limit", "request"}
        Why there was none.
    """

    def __init__(
        self,
        image_estimate: ImageEstimate,
        target: ErrorTarget,
        run: Run,
        direct: DirectEstimate | None = None,
    ) -> None:
        self._image_estimate, self._target, self._run = image_estimate, target, run
        self._direct = direct
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
        elif self._target.reached(self._image_estimate, self._direct):
            self.ended_by = "target_mse"
        elif self._run.stop():
            self.ended_by = "request"
        return self.ended_by != "samples"
