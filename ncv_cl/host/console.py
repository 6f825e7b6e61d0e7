"""Output of the command line, and its exit status: every error is one line."""

from __future__ import annotations

import os
import sys
import traceback
import warnings
from collections.abc import Callable
from typing import Any, TextIO

import pyopencl as cl

# Errors that input can cause. Any other exception is a bug, and its message says so.
EXPECTED = (ValueError, OSError, RuntimeError, MemoryError, ArithmeticError, cl.Error)
# Characters of a message that are printed at most: build logs are long.
LONGEST = 2000
INTERRUPTED = 130


def run(command: Callable[[], int]) -> int:
    """The exit status of a command: its own, or 2 after one line that says what is wrong."""
    # If these were closed when the program started, the next two files opened would get their numbers.
    sys.stdout, sys.stderr = (one or open(os.devnull, "w") for one in (sys.stdout, sys.stderr))  # noqa: SIM115
    # A character that the terminal cannot show must not raise an error.
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        try:
            return command()
        except EXPECTED as error:
            complain(one_line(error))
        except KeyboardInterrupt:
            complain("interrupted")
            return INTERRUPTED
        except Exception as error:
            if sys.flags.dev_mode:
                raise
            frame = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{os.path.basename(frame.filename)}, line {frame.lineno}"
            complain(
                f"internal error, please report it ({place}): {type(error).__name__}: {one_line(error)}"
            )
    return 2


def say(text: str) -> None:
    """Print and flush.

    Raises
    ------
    OSError
        If standard output is closed, or full.
    """
    try:
        print(text, flush=True)
    except OSError as error:
        # Python would try to flush the rest at exit, and fail again.
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
        reason = error.strerror or error
        raise OSError(f"standard output cannot be written to: {reason}") from error


def complain(text: str, kind: str = "error") -> None:
    """Print a line on standard error, unless that is closed."""
    try:
        print(f"ncv-cl: {kind}: {text}", file=sys.stderr, flush=True)
    except OSError:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115


def one_line(error: BaseException) -> str:
    """An error's message in one line."""
    text = "; ".join(line.strip() for line in str(error).splitlines() if line.strip())
    if not text:
        text = "not enough memory" if isinstance(error, MemoryError) else type(error).__name__
    return text if len(text) <= LONGEST else text[:LONGEST] + " ..."


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """`warnings.showwarning` in one line, without what is about the program."""
    try:
        print(f"ncv-cl: warning: {message}", file=sys.stderr, flush=True)
    except OSError:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115


def summary(stats: dict[str, Any]) -> str:
    """A render's statistics as a short table."""
    lines = [f"device   {stats['device']}"]
    lines += [f"{stage:<10}{seconds:>9.3f} s" for stage, seconds in stats["seconds"].items()]
    lines += [
        f"{stats['points']} shading points ({stats['points_skipped']} skipped), "
        f"{stats['samples_per_point']:.4g} samples each on average, "
        f"{stats['rays_traced']} rays traced "
        f"({stats['rays_on_device']} on the device, {stats['rays_skipped']} skipped)"
    ]
    skipped = stats["skipped"]
    lines.append(
        f"skipped  {skipped['background_points']} background points, "
        f"{skipped['points_on_lights']} on lights, {skipped['points_without_light']} that see no light; "
        f"rays worth {skipped['ray_seconds']:.3f} s; "
        f"inputs that do not vary: {', '.join(skipped['inputs']) or 'none'}"
    )
    if "lines" in skipped:
        lines.append(
            f"         {100 * skipped['lines']:.0f} % of first-layer lines miss the square, "
            f"{100 * skipped['dead_neurons']:.0f} % of neurons are zero in it; "
            f"{skipped.get('networks', 0)} networks of coefficient zero"
        )
    if skipped.get("converged_points"):
        lines.append(
            f"         {skipped['converged_points']} points predicted to converge with the fewest, "
            f"{skipped['converged_samples']} samples less than the average"
        )
    if stats.get("residual_variance_ratio") is not None:
        lines.append(f"residual variance / plain variance {stats['residual_variance_ratio']:.4f}")
    estimated = stats.get("estimated_mse")
    lines.append("estimated MSE " + ("not known" if estimated is None else f"{estimated:.6g}"))
    if stats.get("mse") is not None:
        lines.append(f"MSE {stats['mse']:.6g}  relMSE {stats['relmse']:.6g}")
    return "\n".join(lines)


def point_summary(stats: dict[str, Any]) -> str:
    """Statistics of values at points, in a few lines."""
    if not stats["points"]:
        return "no points"
    error = stats["mean_standard_error"]
    known = (
        "not known" if error is None else f"{error:.3g}, at most {stats['largest_standard_error']:.3g}"
    )
    return (
        f"{stats['points']} points, {stats['samples_per_point']:.4g} samples each on average, in "
        f"{stats['seconds']['total']:.3f} s; {stats['points_zero']} are zero, "
        f"{stats['points_on_lights']} on lights, {stats['points_detached']} on no surface\n"
        f"mean standard error {known}"
    )
