"""A scene's textures on the device, as textures.cl looks them up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..opencl.device import Device
from ..opencl.layout import Record
from ..opencl.memory import HostArray
from ..scene.geometry import SMALLEST_ROUGHNESS
from ..scene.model import Scene
from ..scene.textures.texture import WRAPS, Texture

# `first` is the place of an image's first texel among all.
TEXTURE = Record(
    "TEXTURE",
    {"first": 1, "width": 1, "height": 1, "wrap_u": 1, "wrap_v": 1, "nearest": 1},
    np.uint32,
)
# Those of `Maps` that kernels look up.
LOOKED_UP = ("colour", "surface", "emission", "normal")
# The index of what has no texture.
NO_TEXTURE = -1


def texture_defines() -> dict[str, int | str]:
    """The `-D` constants of textures.cl."""
    wraps = {f"WRAP_{name.upper()}": number for number, name in enumerate(WRAPS)}
    return {**TEXTURE.defines(), **wraps, "SMALLEST_ROUGHNESS": f"{SMALLEST_ROUGHNESS!r}f"}


@dataclass(frozen=True)
class Textures:
    """The textures of all materials.

    Attributes
    ----------
    records : HostArray
        uint32 (textures, TEXTURE.size).
    texels : HostArray
        float16 (texels, 4), those of an image row after row, of images that textures share once.
    """

    records: HostArray
    texels: HostArray

    @classmethod
    def of(cls, device: Device, scene: Scene) -> Textures:
        """Those of a scene, in the order of `all_textures`."""
        textures = all_textures(scene)
        images = {id(one.texels): one.texels for one in textures}
        sizes = [image.shape[0] * image.shape[1] for image in images.values()]
        firsts = dict(zip(images, np.cumsum([0, *sizes]).tolist(), strict=False))
        records = [_record(one, firsts[id(one.texels)]) for one in textures]
        texels = HostArray(device, (sum(sizes), 4), np.float16)
        with texels.mapped(write=True) as view:
            for key, image in images.items():
                view[firsts[key] : firsts[key] + image.shape[0] * image.shape[1]] = image.reshape(-1, 4)
        table = np.array(records, np.uint32).reshape(-1, TEXTURE.size)
        return cls(HostArray.of(device, table), texels)


def all_textures(scene: Scene) -> list[Texture]:
    """The textures of a scene's materials that kernels look up, each once."""
    found = (getattr(m.maps, kind) for m in scene.materials if m.maps is not None for kind in LOOKED_UP)
    return list(dict.fromkeys(one for one in found if one is not None))


def texture_index(scene: Scene, kind: str) -> np.ndarray:
    """The index of each material's texture among `all_textures`, int32 (materials,), or `NO_TEXTURE`.

    Parameters
    ----------
    kind : str
        The attribute of `Maps`.
    """
    known: dict[Texture | None, int] = {one: index for index, one in enumerate(all_textures(scene))}
    maps = (material.maps for material in scene.materials)
    found = (None if one is None else getattr(one, kind) for one in maps)
    return np.array([known.get(texture, NO_TEXTURE) for texture in found], np.int32)


def _record(texture: Texture, first: int) -> np.ndarray:
    height, width = texture.texels.shape[:2]
    wrap_u, wrap_v = (WRAPS.index(one) for one in texture.wrap)
    return TEXTURE.pack(
        first=first, width=width, height=height, wrap_u=wrap_u, wrap_v=wrap_v, nearest=texture.nearest
    )
