"""What the stages need to know of an integrand."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from ..points.points import ShadingPoints
from ..scene.load import Scene


class IntegrandError(ValueError):
    """The scene or an option does not suit the integrand."""


class Integrand(ABC):
    """A function f(u, v | φ) on the unit square for every shading point.

    A subclass says which of the network's inputs its f depends on, how many channels it has, and names
    a kernel file that defines ``evaluate_integrand`` (see samples.cl).
    """

    name: ClassVar[str]
    """What the command line calls it."""
    files: ClassVar[tuple[str, ...]]
    """Kernel files, in joining order, that define ``evaluate_integrand``."""
    channels: ClassVar[int]
    inputs: ClassVar[tuple[str, ...]]
    """Network inputs f depends on, as `encode.INPUTS` names them."""
    demodulated: ClassVar[bool]
    """Whether f is easier to learn over its unshadowed mean than as it is."""
    emitters_active: ClassVar[bool]
    """Whether points on area lights have an integral of their own."""
    to_lights: ClassVar[bool] = False
    """Whether every ray ends on an area light, and ``data`` begins with the lights' records."""
    nested: ClassVar[bool] = False
    """Whether f is itself estimated, by paths (`paths.PathSource`)."""

    @abstractmethod
    def data(self, scene: Scene) -> np.ndarray:
        """The float32 array that the kernels call ``integrand_data``."""

    @abstractmethod
    def defines(self, scene: Scene) -> dict[str, int]:
        """The `-D` constants of the integrand's kernel files."""

    def check(self, scene: Scene) -> None:
        """Refuse a scene that does not suit the integrand.

        Raises
        ------
        IntegrandError
            As `data` raises it, or where its numbers are beyond float32: kernels take NaN for no light.
        """
        data = self.data(scene)
        largest = [float(np.max(light.radiance)) * light.area for light in scene.lights]
        finite = np.isfinite(data).all() and np.isfinite(np.array(largest, np.float32)).all()
        if "LIGHT_COUNT" in self.defines(scene) and not finite:
            raise IntegrandError(
                f"{scene.name}: the radiance of a light times its area is beyond float32: scale it down"
            )

    def dark(self, scene: Scene, points: ShadingPoints) -> np.ndarray | None:
        """Where f is zero for every (u, v), as far as that is certain without shadows.

        Returns
        -------
        ndarray, optional
            bool (points.active,); None where no point can be so.
        """
        return None

    def emitted(self, scene: Scene, light: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """What points on lights add by themselves, float32 (points, 3).

        Parameters
        ----------
        light : ndarray
            int32 (points,), index of the light each point lies on.
        outgoing : ndarray
            float32 (3, points), unit directions towards the viewer.
        """
        return np.zeros((len(light), 3), np.float32)

    def glow(self, scene: Scene, material: np.ndarray) -> np.ndarray:
        """What surfaces add by themselves, float32 (points, 3).

        Parameters
        ----------
        material : ndarray
            int32 (points,), index of each point's material.
        """
        return np.zeros((len(material), 3), np.float32)
