"""Valid files with something wrong: cut off, numbers swapped, huge counts, words of no format."""

from __future__ import annotations

import copy
import json
import random
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from mesh_files import SCENE, SQUARE, Gltf, obj_text, ply_bytes, png_bytes, write_image
from mitsuba_files import serialized

# In place of numbers and words of texts.
WORDS = [
    "0", "-1", "1", "-0.0", "nan", "inf", "-inf", "1e308", "-1e39", "1e-320", "2147483648", "4294967295",
    "9223372036854775808", "-9223372036854775809", "1" * 40, "1e", "", "abc", '"', "[", "]", "{", "}",
    "\0", "\u00e9", "true", "null", "#", "\\", "//", "../x", "1/2/3/4", "$a", "&amp;", "<", "65535",
    "16777216",
]  # fmt: skip
# In place of values of JSON.
VALUES: list[Any] = [
    0, -1, 1, 2, 1.5, -0.0, float("nan"), float("inf"), 1e308, 2**31, 2**32 - 1, 2**63, -(2**63), 10**30,
    10**400, "", "abc", "data:,", "../x", None, True, False, [], {}, [0], [[]], {"a": 0}, [1e39] * 16,
    [0] * 3, "SCALAR", "VEC3", "MAT4", 5120, 5126, [float("nan")] * 3,
]  # fmt: skip
_TOKEN = re.compile(r"[^\s,\[\]{}\"=<>/]+")
_COLOURS = np.arange(24, dtype=np.float32).reshape(2, 4, 3) / 24


def write_seeds(folder: Path) -> dict[str, tuple[Path, Path]]:
    """Valid files: of each kind, the scene file to load and the file of it to change."""
    polygons = [SQUARE.tolist()]
    (folder / "a.mtl").write_text(
        "newmtl m\nKd 0.5 0.2 0.1\nKs 0.1 0.1 0.1\nNs 30\nKe 0 0 1\nd 0.5\nillum 2\nPr 0.3\nPm 0.2\n"
        "map_Kd -s 2 2 1 -o 0.1 0.2 t.png\nmap_d t.png\nnorm -bm 1 t.png\n"
    )
    corners = obj_text(polygons).replace(
        "f 1 2 3 4", "vt 0 0\nvn 0 0 1\nusemtl m\nf 1/1/1 2/1/1 3/1/1 -1/-1/-1"
    )
    (folder / "a.obj").write_text(f"mtllib a.mtl\n{corners}s 1\nl 1 2\n")
    (folder / "a.ply").write_bytes(ply_bytes(polygons, "ascii"))
    (folder / "b.ply").write_bytes(ply_bytes(polygons, "binary_little_endian"))
    trimesh.creation.box().export(folder / "b.stl")
    (folder / "a.stl").write_text(trimesh.exchange.stl.export_stl_ascii(trimesh.creation.box()))
    for name, kind in (("t.png", "uint8"), ("t.exr", "half"), ("t.hdr", "float"), ("t.tif", "uint8")):
        write_image(folder / name, _COLOURS * 255 if kind == "uint8" else _COLOURS, kind)
    gltf = _gltf()
    gltf.write(folder / "a.gltf")
    gltf.write(folder / "a.glb")
    (folder / "a.xml").write_text(XML)
    (folder / "a.serialized").write_bytes(serialized(trimesh.creation.box()))
    for file in ("a.obj", "a.ply", "b.ply", "a.stl", "b.stl"):
        _toml(folder / f"{file}.toml", f'[[meshes]]\nfile = "{file}"\n')
    for file in ("t.png", "t.exr", "t.hdr", "t.tif"):
        quad = "[[quads]]\ncorner = [0, 0, 0]\nedge1 = [1, 0, 0]\nedge2 = [0, 1, 0]\nmaterial = 'i'\n"
        _toml(folder / f"{file}.toml", f'[materials.i]\nalbedo = {{ file = "{file}" }}\n{quad}')
    (folder / "a.toml").write_text(SCENE + TOML)
    kinds = {
        name: (folder / f"{name}.toml", folder / name) for name in ("a.ply", "b.ply", "a.stl", "b.stl")
    }
    kinds |= {
        name: (folder / f"{name}.toml", folder / name) for name in ("t.png", "t.exr", "t.hdr", "t.tif")
    }
    kinds |= {name: (folder / name, folder / name) for name in ("a.toml", "a.gltf", "a.glb", "a.xml")}
    return kinds | {
        "a.obj": (folder / "a.obj", folder / "a.obj"),
        "a.serialized": (folder / "a.xml", folder / "a.serialized"),
        "a.mtl": (folder / "a.obj.toml", folder / "a.mtl"),
    }


def mutated(data: bytes, name: str, seed: int) -> bytes:
    """A file's content with one to four things changed, the same for the same seed."""
    chance = random.Random(f"{name} {seed}")
    suffix = name.rpartition(".")[2]
    for _ in range(chance.choice((1, 1, 2, 4))):
        if suffix == "gltf" and chance.random() < 0.8:
            data = _json_changed(data, chance)
        elif suffix == "glb" and chance.random() < 0.6:
            data = _glb_changed(data, chance)
        elif suffix in ("toml", "obj", "mtl", "gltf", "xml") or name in ("a.ply", "a.stl"):
            data = _text_changed(data, chance)
        else:
            data = _bytes_changed(data, chance)
    return data


def _toml(path: Path, text: str) -> None:
    path.write_text(SCENE + text, encoding="utf-8")


def _gltf() -> Gltf:
    gltf = Gltf()
    primitive = gltf.square(material=0, mode=4)
    primitive["attributes"] |= {
        "TEXCOORD_0": gltf.accessor(SQUARE[:, :2].copy()),
        "NORMAL": gltf.accessor(np.tile(np.float32([0, 0, 1]), (4, 1))),
        "COLOR_0": gltf.accessor(np.full((4, 3), 0.5, np.float32)),
        "JOINTS_0": gltf.accessor(np.zeros((4, 4), np.uint8)),
        "WEIGHTS_0": gltf.accessor(np.full((4, 4), 0.25, np.float32)),
    }
    moved = gltf.accessor(SQUARE)
    primitive["targets"] = [{"POSITION": moved}]
    gltf.tree["accessors"][moved] |= {
        "sparse": {
            "count": 1,
            "indices": {"bufferView": gltf.view(b"\0\0\0\0"), "componentType": 5125},
            "values": {"bufferView": gltf.view(struct.pack("<3f", 1, 2, 3))},
        }
    }
    image = gltf.view(png_bytes(100, 150, 200))
    matrices = gltf.accessor(np.eye(4, dtype=np.float32).reshape(1, 16))
    instances = {"TRANSLATION": gltf.accessor(np.zeros((2, 3), np.float32))}
    gltf.tree |= {
        "extensionsUsed": ["KHR_lights_punctual", "EXT_mesh_gpu_instancing"],
        "extensions": {
            "KHR_lights_punctual": {"lights": [{"type": "spot", "spot": {}, "color": [1, 1, 0]}]}
        },
        "scenes": [{"nodes": [0, 1, 2, 4, 5]}],
        "nodes": [
            {"mesh": 0, "scale": [1, 2, 1], "rotation": [0, 0, 0, 1], "children": [3], "weights": [0.5]},
            {"camera": 0, "translation": [0, 0, 5]},
            {"mesh": 0, "skin": 0},
            {"matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
            {"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": instances}}},
            {"extensions": {"KHR_lights_punctual": {"light": 0}}, "translation": [1, 1, 9]},
        ],
        "meshes": [{"primitives": [primitive], "weights": [0.1]}],
        "skins": [{"joints": [3], "inverseBindMatrices": matrices}],
        "cameras": [{"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.1}}],
        "materials": [
            {
                "pbrMetallicRoughness": {
                    "baseColorTexture": {
                        "index": 0,
                        "extensions": {"KHR_texture_transform": {"scale": [2, 2], "offset": [0, 1]}},
                    },
                    "baseColorFactor": [1, 0.5, 0.5, 1],
                    "roughnessFactor": 0.5,
                },
                "normalTexture": {"index": 0, "scale": 0.5},
                "emissiveFactor": [0, 0, 1],
                "alphaMode": "MASK",
                "alphaCutoff": 0.4,
                "extensions": {"KHR_materials_ior": {"ior": 1.4}},
            }
        ],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"wrapS": 33071, "magFilter": 9728}],
        "images": [{"bufferView": image, "mimeType": "image/png"}],
    }
    return gltf


def _text_changed(data: bytes, chance: random.Random) -> bytes:
    text = data.decode("utf-8", errors="surrogateescape")
    kind = chance.randrange(8)
    lines = text.splitlines(keepends=True) or [""]
    line = chance.randrange(len(lines))
    if kind == 0:
        return data[: chance.randrange(len(data) + 1)]
    if kind == 1:
        return _bytes_changed(data, chance)
    if kind == 2:
        del lines[line]
        return "".join(lines).encode("utf-8", errors="surrogateescape")
    if kind == 3:
        lines.insert(chance.randrange(len(lines)), lines[line] * chance.choice((1, 2, 50)))
        return "".join(lines).encode("utf-8", errors="surrogateescape")
    tokens = list(_TOKEN.finditer(text))
    if not tokens:
        return data
    token = chance.choice(tokens)
    word = chance.choice(WORDS) if kind < 7 else chance.choice(tokens)[0]
    return (text[: token.start()] + word + text[token.end() :]).encode("utf-8", errors="surrogateescape")


def _bytes_changed(data: bytes, chance: random.Random) -> bytes:
    kind, size = chance.randrange(4), len(data)
    start = chance.randrange(size + 1)
    if kind == 0:
        return data[:start]
    if kind == 1:
        return data[:start] + data[start + chance.randrange(1, 9) :]
    width = chance.choice((1, 2, 4, 8))
    value = chance.choice(
        (0, 1, (1 << 8 * width) - 1, (1 << 8 * width - 1) - 1, chance.getrandbits(8 * width))
    )
    new = value.to_bytes(width, chance.choice(("little", "big")))
    if kind == 2 and chance.random() < 0.5:
        new = struct.pack("<f", chance.choice((float("nan"), float("inf"), -1e38, 1e-45)))
    return (data[:start] + new + data[start + len(new) :])[: max(size, 1)]


def _json_changed(data: bytes, chance: random.Random) -> bytes:
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return _bytes_changed(data, chance)
    places: list[tuple[Any, Any]] = []
    waiting = [tree]
    while waiting:
        one = waiting.pop()
        entries = (
            one.items() if isinstance(one, dict) else enumerate(one) if isinstance(one, list) else ()
        )
        for key, value in list(entries):
            places.append((one, key))
            waiting.append(value)
    if not places:
        return data
    (parent, key), (other, of) = chance.choice(places), chance.choice(places)
    kind = chance.randrange(6)
    if kind == 0:
        del parent[key]
    elif kind == 1:
        parent[key] = copy.deepcopy(other[of])
    elif kind == 2 and isinstance(parent, list):
        parent *= chance.choice((2, 100))
    else:
        parent[key] = copy.deepcopy(chance.choice(VALUES))
    return json.dumps(tree).encode()


def _glb_changed(data: bytes, chance: random.Random) -> bytes:
    """A change of a GLB's JSON, with lengths that are right."""
    size = int.from_bytes(data[12:16], "little")
    if data[:4] != b"glTF" or 20 + size > len(data):
        return _bytes_changed(data, chance)
    text = _json_changed(data[20 : 20 + size], chance)
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    return head + text + rest


TOML = """
[materials.m]
albedo = { file = "t.png", scale = [1, 2], offset = 0.5, wrap = ["repeat", "clamp"], filter = "nearest" }
reflectance = 0.04
roughness = 0.3
emission = [0, 1, 0]
normal = { file = "t.png", scale = [1, 2], offset = 0.5 }
[[quads]]
corner = [0, 0, 0]
edge1 = [1, 0, 0]
edge2 = [0, 1, 0]
material = "m"
[[boxes]]
center = [1, 1, 1]
size = [1, 2, 1]
rotate = { axis = [0, 1, 0], angle = 30 }
material = "m"
[[spheres]]
center = [0, 3, 0]
radius = 0.5
subdivisions = 1
material = "m"
[[polygons]]
vertices = [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]]
material = "grey"
[[meshes]]
file = "a.obj"
translate = [0, 1, 0]
scale = [1, 1, 2]
smooth = true
[[meshes]]
vertices = [[0, 0, 0], [1, 0, 0], [1, 0, 1]]
triangles = [[0, 1, 2]]
material = "grey"
[[lights]]
corner = [0, 5, 0]
edge1 = [1, 0, 0]
edge2 = [0, 0, 1]
radiance = [1, 2, 3]
two_sided = true
[[lights]]
kind = "spot"
position = [3, 5, 0]
target = [0, 0, 0]
intensity = [1, 2, 3]
inner_angle = 10
outer_angle = 20
radius = 0.01
[[lights]]
kind = "sphere"
centre = [-3, 5, 0]
radius = 0.5
radiance = 4
[[lights]]
kind = "directional"
direction = [0, -1, 0]
irradiance = 2
[materials.glass]
transmission = [1, 0.9, 0.8]
ior = 1.4
[environment]
file = "t.exr"
scale = 0.5
rotation = 30
[environment.sun]
elevation = 30
azimuth = 10
irradiance = [3, 2, 1]
"""

XML = """<?xml version="1.0" encoding="utf-8"?>
<scene version="0.6.0">
  <default name="f" value="40"/>
  <sensor type="perspective" id="c"><float name="fov" value="$f"/>
    <string name="fovAxis" value="smaller"/>
    <transform name="toWorld"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="48"/></film>
  </sensor>
  <bsdf type="twosided" id="w">
    <bsdf type="diffuse"><rgb name="reflectance" value="#ff8000"/></bsdf></bsdf>
  <bsdf type="roughplastic" id="v"><rgb name="diffuseReflectance" value="0.1 0.2 0.3"/>
    <float name="alpha" value="0.2"/><float name="intIOR" value="1.5"/></bsdf>
  <bsdf type="roughconductor" id="m"><string name="material" value="Au"/></bsdf>
  <bsdf type="mask" id="k"><float name="opacity" value="0.7"/><ref id="w"/></bsdf>
  <bsdf type="principled" id="p"><float name="metallic" value="0.3"/>
    <rgb name="base_color" value="1 0 0"/></bsdf>
  <bsdf type="diffuse" id="x"><texture type="bitmap" name="reflectance">
    <string name="filename" value="t.png"/><float name="uscale" value="2"/></texture></bsdf>
  <shape type="rectangle"><transform name="toWorld"><rotate x="1" angle="90"/><scale value="2"/>
    <translate y="-1"/></transform><ref id="x"/></shape>
  <shape type="rectangle">
    <transform name="toWorld"><matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/></transform>
    <emitter type="area"><rgb name="radiance" value="0.5 1 2"/></emitter></shape>
  <shape type="obj"><string name="filename" value="a.obj"/><ref id="v"/></shape>
  <shape type="ply"><string name="filename" value="b.ply"/><boolean name="faceNormals" value="true"/>
    <ref id="m"/></shape>
  <shape type="cube"><ref id="k"/></shape>
  <shape type="cylinder"><point name="p0" x="0" y="1" z="0"/><float name="radius" value="0.1"/>
    <ref id="p"/></shape>
  <shape type="sphere"><point name="center" x="1" y="1" z="0"/><ref id="x"/></shape>
  <shape type="disk"><ref id="x"/></shape>
  <shape type="serialized"><string name="filename" value="a.serialized"/></shape>
  <emitter type="spot"><float name="cutoff_angle" value="30"/></emitter>
  <emitter type="envmap"><string name="filename" value="t.exr"/></emitter>
  <shape type="shapegroup" id="g"><shape type="cube"/></shape>
  <shape type="instance"><ref id="g"/><transform name="toWorld"><translate y="3"/></transform></shape>
</scene>
"""
