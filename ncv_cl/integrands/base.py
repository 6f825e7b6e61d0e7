"""The base class of integrands: what the stages need to know of one."""

from __future__ import annotations

import hashlib
import inspect
import re
from pathlib import Path
from typing import ClassVar

import numpy as np

from ..host.files import some_of
from ..opencl.program import KernelFile, KernelText, kernel_files, source
from ..points.points import INPUTS, ShadingPoints, surface_defines
from ..scene.load import Scene
from .light_sources import light_sources
from .lights import LIGHT_FILES

# Numbers of channels that an integrand may have.
CHANNELS = (1, 3)
# `-D` constants that other modules set in an integrand's program.
TAKEN = {"VEC", "LANES", "USE_FMA", *surface_defines()}
# The kernel function that an integrand's file must define.
FUNCTION = "evaluate_integrand"


class IntegrandError(ValueError):
    """The scene or an option does not suit the integrand, or a class is none."""


class Integrand:
    """A function f(u, v | φ) on the unit square for every shading point.

    A subclass says which of the network's inputs its f depends on, how many channels it has, and names
    a kernel file that defines ``evaluate_integrand`` (see samples.cl). It may be anybody's: class and
    kernel file need not be part of the package (docs/python.md).
    """

    name: ClassVar[str]
    """What the command line calls it, and metadata."""
    files: ClassVar[tuple[str | Path | KernelText, ...]]
    """Kernel files, in joining order, that define ``evaluate_integrand``. The package's own are named
    without suffix; other names end in ``.cl`` and are relative to the class's Python file."""
    channels: int
    """1, which makes a grey picture, or 3."""
    inputs: ClassVar[tuple[str, ...]]
    """Network inputs f depends on, some of `points.INPUTS` in their order, position among them."""
    demodulated: ClassVar[bool] = False
    """Whether f is easier to learn over its unshadowed mean than as it is."""
    emitters_active: ClassVar[bool] = True
    """Whether points on area lights have an integral of their own."""
    to_lights: ClassVar[bool] = False
    """Whether every ray ends on an area light, and ``data`` begins with the lights' records."""
    along_lines: ClassVar[bool] = False
    """Whether lines of constant u lie straight on one light each, as lights.cl places them."""
    sliced: ClassVar[bool] = False
    """Whether v is the azimuth about the normal, and the integral over u of f with visibility up to a
    distance of ``data[0]`` is what slices.cl finds."""
    splits: ClassVar[bool] = False
    """Whether there are scenes in which `apart` gives two parts."""
    nested: ClassVar[bool] = False
    """Whether f is itself estimated, by paths (`paths.PathSource`)."""
    guided: bool = False
    """Whether training learns densities that guide those paths."""

    def apart(self, scene: Scene) -> tuple[Integrand, Integrand] | None:
        """Direct light and the rest as integrands whose sum this one is; None: it has no parts."""
        return None

    def promises(self, name: str) -> bool:
        """Whether the kernel keeps what `to_lights`, `along_lines` or `sliced` says of it.

        A class of one's own inherits none of these: its kernel may be another, so it must say so itself.
        """
        kind = type(self)
        if kind.__module__.startswith("ncv_cl."):
            return bool(getattr(self, name))
        return name in vars(kind) and bool(getattr(self, name))

    def data(self, scene: Scene) -> np.ndarray:
        """The float32 array that the kernels call ``integrand_data``; by default empty."""
        return np.zeros(0, np.float32)

    def defines(self, scene: Scene) -> dict[str, int | str]:
        """The `-D` constants of the integrand's kernel files; CHANNELS is always one of them."""
        return {"CHANNELS": self.channels}

    def kernels(self) -> tuple[KernelFile, ...]:
        """`files` as `program.build` takes them: those that are not the package's are read.

        Raises
        ------
        IntegrandError
            If one of them cannot be read.
        """
        # What lights.cl builds upon comes with it.
        pairs = [LIGHT_FILES if file == LIGHT_FILES[-1] else (file,) for file in self.files]
        names = dict.fromkeys(file for pair in pairs for file in pair)
        return tuple(self._kernel(file) for file in names)

    @property
    def options(self) -> dict[str, object]:
        """The object's attributes that are numbers, text or None, by name."""
        plain = (int, float, str, type(None))
        return {k: v for k, v in vars(self).items() if isinstance(v, plain) and not k.startswith("_")}

    def digest(self, scene: Scene) -> str | None:
        """A hash of what kernels get from a class that is not the package's; None for the package's."""
        if type(self).__module__.startswith("ncv_cl."):
            return None
        declared = (self.channels, self.inputs, self.demodulated, self.emitters_active, self.to_lights)
        texts = [file if isinstance(file, str) else file.text for file in self.kernels()]
        parts = (declared, texts, sorted(self.defines(scene).items()))
        return hashlib.sha256(repr(parts).encode() + self.data(scene).tobytes()).hexdigest()

    def check(self, scene: Scene) -> None:
        """Refuse a class that is no integrand, or a scene that does not suit it.

        Raises
        ------
        IntegrandError
            As `data` and `kernels` raise it; if the class lacks an attribute or has a wrong one; or if a
            light's numbers overflow float32, since kernels take NaN for no light.
        """
        self._check_declared()
        self._check_kernels()
        data, defines = self.data(scene), self.defines(scene)
        own = type(self).__name__
        if not isinstance(data, np.ndarray) or data.dtype != np.float32:
            kind = data.dtype if isinstance(data, np.ndarray) else type(data).__name__
            raise IntegrandError(f"{own}.data must return an array of float32, returned {kind}")
        if not isinstance(defines, dict) or defines.get("CHANNELS") != self.channels:
            raise IntegrandError(
                f"{own}.defines must return what super().defines(scene) does, and may add to it: "
                f"CHANNELS must be {self.channels}"
            )
        if taken := sorted(TAKEN & set(defines)):
            raise IntegrandError(f"{own}.defines: the name {taken[0]} is taken, choose another")
        lights = light_sources(scene).lights
        largest = lights.radiance.max(axis=1, initial=0.0) * lights.area
        finite = np.isfinite(data).all() and np.isfinite(largest.astype(np.float32)).all()
        if "LIGHT_COUNT" in defines and not finite:
            raise IntegrandError(
                f"{scene.name}: the radiance of a light times its area is beyond float32: scale it down"
            )

    def point_kernel(self, scene: Scene) -> str | None:
        """The kernel of `files`, if any, that adds to every shading point what its samples share.

        Its arguments are `point_count`, the active points, `total_points`, `surface` and
        `integrand_data`, which is `data`.
        """
        return None

    def _check_declared(self) -> None:
        """Raise if an attribute of the class is missing or wrong."""
        own = type(self).__name__
        missing = [name for name in ("name", "files", "channels", "inputs") if not hasattr(self, name)]
        if missing:
            raise IntegrandError(f"{own} does not say its {', '.join(missing)}")
        if self.channels not in CHANNELS:
            raise IntegrandError(f"{own}.channels must be 1 or 3, is {self.channels!r}")
        if not isinstance(self.files, (tuple, list)) or not self.files:
            raise IntegrandError(f"{own}.files must be a tuple of kernel files, is {self.files!r}")
        try:
            inputs = some_of(f"{own}.inputs", self.inputs, INPUTS)
        except ValueError as error:
            raise IntegrandError(str(error)) from error
        if "position" not in inputs:
            raise IntegrandError(f"{own}.inputs must hold position, are {self.inputs!r}")

    def _check_kernels(self) -> None:
        """Raise if a kernel file that is not the package's cannot be read, or lacks the function."""
        kernels = self.kernels()
        theirs = [file.name for file in kernels if isinstance(file, KernelText)]
        if not theirs:
            return
        if self.nested:
            raise IntegrandError(f"{type(self).__name__}: only integrand gi can be nested")
        code = re.sub(r"/\*.*?\*/|//[^\n]*", " ", source(kernels), flags=re.DOTALL)
        if not re.search(rf"\bvoid\s+{FUNCTION}\s*\(", code):
            raise IntegrandError(f"{' and '.join(theirs)}: void {FUNCTION}(...) is not defined there")

    def _kernel(self, file: object) -> KernelFile:
        """One of `files`."""
        own = type(self).__name__
        if isinstance(file, KernelText):
            return file
        if not isinstance(file, (str, Path)):
            raise IntegrandError(f"{own}.files: a name, a path or a KernelText is needed, not {file!r}")
        if Path(file).suffix != ".cl":
            if str(file) not in kernel_files():
                raise IntegrandError(
                    f"{own}.files: the package has no kernel file {str(file)!r}, and those of your own "
                    "end in .cl"
                )
            return str(file)
        path = self._folder() / file
        try:
            return KernelText.read(path)
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise IntegrandError(f"{own}.files: cannot read {path}: {reason}") from error

    def _folder(self) -> Path:
        """The folder of the Python file that sets `files`; the working directory if there is none."""
        owner = next(one for one in type(self).__mro__ if "files" in vars(one))
        try:
            return Path(inspect.getfile(owner)).parent
        except (OSError, TypeError):
            return Path()

    def dark(self, scene: Scene, points: ShadingPoints) -> np.ndarray | None:
        """Points where f is zero for every (u, v), for reasons other than shadows.

        Returns
        -------
        ndarray, optional
            bool (points.active,); None where no point can be so.
        """
        return None

    def remark(self, mean: float) -> str | None:
        """What to warn of, where a picture came out as is seldom meant; None where it did not.

        Parameters
        ----------
        mean : float
            Of all pixels and channels, over what the camera sees of the scene.
        """
        return None

    def unseen(self, scene: Scene, material: np.ndarray) -> str | None:
        """What to warn of that the integrand leaves out of what the camera sees; None: nothing.

        Parameters
        ----------
        material : ndarray
            int32 (points,), index of each point's material.
        """
        return None

    def emitted(self, scene: Scene, light: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """Radiance that points on lights emit, which is added to the pixels, float32 (points, 3).

        Parameters
        ----------
        light : ndarray
            int32 (points,), index of the light each point lies on.
        outgoing : ndarray
            float32 (3, points), unit directions towards the viewer.
        """
        return np.zeros((len(light), 3), np.float32)

    def background(self, scene: Scene, directions: np.ndarray) -> np.ndarray | None:
        """Radiance that pixels show where the camera sees nothing of the scene, float64 (n, 3).

        Parameters
        ----------
        directions : ndarray
            float64 (n, 3), unit directions that the camera looks in.

        Returns
        -------
        ndarray, optional
            None where that is black.
        """
        return None

    def glow(self, scene: Scene, material: np.ndarray) -> np.ndarray:
        """Radiance that surfaces emit, which is added to the pixels, float32 (points, 3).

        Parameters
        ----------
        material : ndarray
            int32 (points,), index of each point's material.
        """
        return np.zeros((len(material), 3), np.float32)
