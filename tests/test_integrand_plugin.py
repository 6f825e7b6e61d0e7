"""Integrands outside the package: found, built, right by closed forms, and errors that say where."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from reference import camera_at, grey, mesh_scene, quad, sampling, shadowed_values, tangent_frame, unit
from test_clang import CLANG, diagnostics

import ncv_cl as ncv
from ncv_cl import IntegrandError, KernelText
from ncv_cl.cli import main
from ncv_cl.integrands import INTEGRANDS
from ncv_cl.integrands.named import named_integrand
from ncv_cl.opencl import program
from ncv_cl.opencl.program import kernel_files
from ncv_cl.output.checkpoint import CheckpointError

EXAMPLE = Path(__file__).parent.parent / "examples" / "my_integrand"
SKY = f"{EXAMPLE / 'sky.py'}:Sky"
SAMPLES = 4096
ABOVE, BELOW = np.array([0.5, 0.8, 1.6]), np.array([0.3, 0.25, 0.2])
ALBEDO = np.array([0.5, 0.7, 0.9])

HEAD = """void evaluate_integrand(const ShadingPoint *p, global const float *restrict integrand_data,
                        const real u, const real v, real value[CHANNELS], real direction[3],
                        real *distance) {
"""
# Of no shadow: a ray that ends where it begins.
OPEN = """  direction[0] = direction[1] = direction[2] = (real)1.0f;
  *distance = (real)1e-6f;
}
"""
CODE = """
import numpy as np
import ncv_cl as ncv

class Mine(ncv.Integrand):
    name = "mine"
    files = ("mine.cl",)
    channels = 1
    inputs = ("position",)
"""
BODY = "  value[0] = u + (real)(p->position.x * 0.0f);\n"


def sky(**options: object) -> ncv.Integrand:
    return type(named_integrand(SKY))(**options)


def write(folder: Path, body: str = BODY, code: str = CODE) -> str:
    """A class and its kernel file; returns the class's name on the command line."""
    (folder / "mine.cl").write_text(HEAD + body + OPEN)
    (folder / "mine.py").write_text(code)
    return f"{folder / 'mine.py'}:Mine"


def text(body: str, name: str = "typed.cl") -> KernelText:
    return KernelText(name, HEAD + body + OPEN)


def typed(body: str = BODY, **attributes: object) -> ncv.Integrand:
    """An object of a class without a file."""
    usual = {"name": "typed", "files": (text(body),), "channels": 1, "inputs": ("position",)}
    return type("Typed", (ncv.Integrand,), {**usual, **attributes})()


def floor(extent: float = 1.0) -> ncv.Scene:
    square = quad([-extent, -extent, 0], [2 * extent, 0, 0], [0, 2 * extent, 0])
    return mesh_scene(square, camera_at([0, 0, 2], [0, 0, 0], 20), materials=(grey(ALBEDO),))


def at_a_wall() -> ncv.Scene:
    """A floor that ends at a wall, which hides all directions of positive x."""
    wide = 2000.0
    parts = [quad([-wide, -wide, 0], [wide, 0, 0], [0, 2 * wide, 0])]
    parts.append(quad([0, -wide, 0], [0, 2 * wide, 0], [0, 0, wide]))
    camera = camera_at([-0.02, 0, 0.02], [-0.02, 0, 0], 30)
    return mesh_scene(np.concatenate(parts), camera, materials=(grey(ALBEDO),))


def options(device: object, **others: object) -> dict[str, object]:
    return {"spp": 16, "size": (8, 8), "seed": 3, "device": device, **others}


# ------------------------------------------------------------------------------- the example, exactly


@pytest.mark.parametrize(
    "normal", [[0, 1, 0], [0, -1, 0], [0.3, -0.5, 0.2], [1, 0, 0], [-0.6, 0.1, -0.4]]
)
def test_an_open_surface_gets_the_whole_sky(device, normal):
    normal = unit(np.array(normal, float))
    tangent, bitangent = tangent_frame(normal)
    square = quad(-tangent - bitangent, 2 * tangent, 2 * bitangent)
    camera = camera_at(2 * normal, [0, 0, 0], 20, tangent)
    scene = mesh_scene(square, camera, materials=(grey(ALBEDO),))
    points, source, rays = sampling(device, scene, sky(), (3, 1), SAMPLES)
    values = shadowed_values(source.draw(range(3), range(SAMPLES), 0), 3)
    # The mean of w over the hemisphere, weighted by cos / pi, is 2/3 of the normal.
    exact = ALBEDO * (BELOW + (ABOVE - BELOW) * (1 / 2 + normal[1] / 3))
    np.testing.assert_allclose(values.mean(axis=-1), np.tile(exact[:, None], 3), rtol=1e-4)
    assert points.active == 3 and (rays.distances == np.inf).all()


def beside_the_wall(up: np.ndarray) -> np.ndarray:
    """What is left of the sky there: half of the hemisphere about z, that of negative x."""
    part = 1 / 4 + (up[2] / 3 - up[0] * 2 / (3 * np.pi)) / 2
    return ALBEDO * (BELOW / 2 + (ABOVE - BELOW) * part)


@pytest.mark.parametrize("up", [[0, 0, 1.0], [0.6, 0, 0.8], [-0.8, 0.0, 0.6]])
def test_a_wall_hides_half_of_the_sky(device, up):
    _, source, _ = sampling(device, at_a_wall(), sky(up=tuple(up)), (3, 1), SAMPLES)
    values = shadowed_values(source.draw(range(3), range(SAMPLES), 0), 3)
    exact = np.tile(beside_the_wall(np.array(up))[:, None], 3)
    np.testing.assert_allclose(values.mean(axis=-1), exact, rtol=1e-4)


@pytest.mark.parametrize("method", ["mc", "ncv"])
def test_renders_are_exact_within_their_own_deviation(one_device, method):
    image = ncv.render(
        at_a_wall(), sky(up=(0, 0, 1)), method, **options(one_device, spp=64, size=(16, 16))
    )
    errors = image.pixels - beside_the_wall(np.array([0, 0, 1.0]))
    # The channels have the same samples, so that each has a score of its own.
    scores = errors.sum(axis=(0, 1)) / np.sqrt(image.variance.sum(axis=(0, 1)))
    assert (np.abs(scores) < 3).all()
    assert 0 < image.stats["estimated_mse"] < 2e-3
    assert image.stats["method"] == method and image.metadata["integrand"] == "sky"


def test_the_control_variate_learns_it(one_device, scenes):
    image = ncv.render(
        scenes / "knot.toml", sky(), "ncv", train_spp=32, **options(one_device, spp=64, size=(48, 48))
    )
    assert image.stats["residual_variance_ratio"] < 0.5


# ------------------------------------------------------------------- files, texts, and shipped kernels


def test_the_command_line_renders_what_python_does(one_device, scenes, tmp_path, capsys):
    scene, output = scenes / "knot.toml", tmp_path / "sky.exr"
    arguments = ["--integrand", SKY, "--method", "mc", "--spp", "16", "--size", "8x8", "--seed", "3"]
    arguments += ["--device", str(one_device.index), "-o", str(output)]
    assert main(["render", str(scene), *arguments]) == 0, capsys.readouterr().err
    written = ncv.Image.read(output).pixels
    for integrand in (sky(), SKY):
        image = ncv.render(scene, integrand, "mc", **options(one_device))
        assert image.pixels.any()
        np.testing.assert_array_equal(image.pixels.astype(np.float32), written)


@pytest.mark.parametrize("method", ["mc", "ncv"])
def test_a_copy_of_a_shipped_integrand_gives_its_bits(one_device, scenes, tmp_path, method):
    """With lights' records, occluder lists, and shipped kernel files before its own."""
    shutil.copy(kernel_files()["direct"], tmp_path / "copy.cl")
    code = "import ncv_cl\nclass Mine(ncv_cl.DirectLight):\n    to_lights = along_lines = True\n"
    code += '    files = (*ncv_cl.DirectLight.files[:-1], "copy.cl")\n'
    name = write(tmp_path, code=code)
    pictures = [
        ncv.render(scenes / "cornell_box.toml", integrand, method, **options(one_device)).pixels
        for integrand in (name, "direct")
    ]
    assert pictures[0].any()
    np.testing.assert_array_equal(*pictures)


def test_files_are_found_beside_the_class_by_path_and_as_text(one_device, tmp_path, monkeypatch):
    name = write(tmp_path)
    monkeypatch.chdir(tmp_path.parent)
    found = named_integrand(name)
    below = type("Below", (type(found),), {})()
    by_path = typed(files=(tmp_path / "mine.cl",))
    pictures = [
        ncv.render(floor(), integrand, "mc", **options(one_device)).pixels
        for integrand in (found, below, by_path, typed())
    ]
    for picture in pictures:
        np.testing.assert_array_equal(picture, pictures[0])
    np.testing.assert_allclose(pictures[0], 0.5, atol=0.05)


def test_an_edited_kernel_file_is_built_anew(one_device, tmp_path):
    name = write(tmp_path)
    first = ncv.render(floor(), name, "mc", **options(one_device)).pixels
    write(tmp_path, "  value[0] = 3.0f * u + (real)(p->position.x * 0.0f);\n")
    second = ncv.render(floor(), name, "mc", **options(one_device)).pixels
    np.testing.assert_allclose(second, 3 * first, rtol=1e-6)


def test_data_and_constants_reach_the_kernel(one_device):
    class Given(ncv.Integrand):
        name = "given"
        files = (text("  for (uint c = 0; c < CHANNELS; ++c) value[c] = integrand_data[c] * FACTOR;\n"),)
        channels = 3
        inputs = ("position",)

        def __init__(self):
            self.weights = np.array([1, 2, 4], np.float32)
            self.factor, self.seed, self.nothing = 0.5, "a clash", None

        def data(self, scene):
            return self.weights

        def defines(self, scene):
            return {**super().defines(scene), "FACTOR": f"{self.factor}f"}

    image = ncv.render(floor(), Given(), "mc", **options(one_device))
    np.testing.assert_array_equal(image.pixels, np.tile(np.float32([0.5, 1, 2]), (8, 8, 1)))
    # Metadata hold what is a number or text, and no attribute takes the place of what was there.
    assert image.metadata["factor"] == 0.5 and image.metadata["seed"] == 3
    assert not {"weights", "nothing"} & set(image.metadata)


@pytest.mark.parametrize("method", ["mc", "ncv"])
def test_values_may_be_negative(one_device, method):
    """Their rays are traced as those of others are: the half of the square below zero counts."""
    signed = typed("  value[0] = u - 0.75f + (real)(p->position.x * 0.0f);\n")
    image = ncv.render(floor(), signed, method, **options(one_device, spp=64))
    scores = (image.pixels[..., 0] + 0.25).sum() / np.sqrt(image.variance[..., 0].sum())
    assert abs(scores) < 3 and image.variance.max() < 1e-3


def test_the_example_passes_clang_without_a_warning(one_device):
    if CLANG is None:
        pytest.skip("clang is not installed")
    with pytest.MonkeyPatch.context() as patch:
        built = {}
        patch.setattr(program, "_programs", built)
        ncv.render(floor(), sky(), "ncv", **options(one_device, spp=2, size=(4, 4)))
    own = [one for one in built.values() if any(isinstance(file, KernelText) for file in one.files)]
    assert len(own) == 2
    for one in own:
        files = tuple(
            file if isinstance(file, str) else KernelText("sky.cl", file.text) for file in one.files
        )
        for shape in ({}, {"VEC": 1, "LANES": 32}, {"VEC": 16, "LANES": 1}):
            names = tuple(file if isinstance(file, str) else file.name for file in files)
            source = program.source(files)
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(program, "source", lambda _, source=source: source)
                assert not diagnostics(names, {**one.defines, **shape})


# ----------------------------------------------------------------------------------------- checkpoints


def test_a_checkpoint_goes_on_with_the_same_kernel_only(one_device, tmp_path):
    name, file = write(tmp_path), tmp_path / "checkpoint.npz"
    render = {"method": "mc", **options(one_device, spp=256)}
    whole = ncv.render(floor(), name, **render)
    ncv.render(floor(), name, **render, checkpoint=file, stop=lambda: True)
    np.testing.assert_array_equal(ncv.render(floor(), name, **render, resume=file).pixels, whole.pixels)
    write(tmp_path, BODY.replace("u +", "v +"))
    with pytest.raises(CheckpointError, match="integrand's hash is"):
        ncv.render(floor(), name, **render, resume=file)


def test_the_hash_is_of_all_that_kernels_get(tmp_path):
    scene, first = floor(), typed()
    others = [
        typed(BODY + " "),
        typed(inputs=("position", "normal")),
        typed(emitters_active=False),
        typed(data=lambda self, scene: np.ones(1, np.float32)),
        typed(defines=lambda self, scene: {"CHANNELS": 1, "MORE": 1}),
    ]
    assert len({one.digest(scene) for one in (first, typed(), *others)}) == 1 + len(others)
    assert typed(files=(text(BODY, "elsewhere.cl"),)).digest(scene) == first.digest(scene)
    # The package's own are known by its version and the hash of its kernels.
    assert {kind().digest(scene) for kind in INTEGRANDS.values()} == {None}


# ---------------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("none.py:Mine", "there is no file none.py"),
        ("mine.cl:Mine", "must end in .py: mine.cl"),
        ("mine.py:Yours", "mine.py has no integrand 'Yours'; those it has: Mine"),
        ("mine.py:np", "has no integrand 'np'"),
        ("mine.py:", "has no integrand ''"),
        ("broken.py:Mine", "broken.py:2: ZeroDivisionError"),
        ("syntax.py:Mine", "syntax.py:1: SyntaxError"),
        ("imports.py:Mine", "imports.py:1: ModuleNotFoundError"),
        ("demanding.py:Mine", "cannot be made without arguments"),
        ("lonely.py:Mine", "cannot read lonely.cl: No such file or directory"),
        ("mine", "choose from ao, direct, gi, or a class of your own, FILE.py:CLASS"),
    ],
)
def test_what_is_not_found_is_named_in_a_line(tmp_path, monkeypatch, capsys, scenes, name, said):
    monkeypatch.chdir(tmp_path)
    write(tmp_path)
    (tmp_path / "broken.py").write_text("x = 1\ny = x / 0\n")
    (tmp_path / "syntax.py").write_text("def\n")
    (tmp_path / "imports.py").write_text("import no_such_module\n")
    (tmp_path / "demanding.py").write_text(CODE + "    def __init__(self, radius): pass\n")
    (tmp_path / "lonely.py").write_text(CODE.replace("mine.cl", "lonely.cl"))
    try:
        status = main(["render", str(scenes / "knot.toml"), "--integrand", name, "-o", "a.png"])
    except SystemExit as stopped:
        status = stopped.code
    err = capsys.readouterr().err.replace(f"{tmp_path}/", "")
    assert status == 2 and said in err.splitlines()[-1], err
    assert "Traceback" not in err


def test_an_object_of_a_file_may_be_named(tmp_path):
    write(tmp_path, code=CODE + "    def __init__(self, a): self.a = a\nsmall = Mine(0.25)\n")
    assert named_integrand(f"{tmp_path / 'mine.py'}:small").a == 0.25
    with pytest.raises(IntegrandError, match="those it has: Mine, small"):
        named_integrand(f"{tmp_path / 'mine.py'}:large")


@pytest.mark.parametrize(
    ("attributes", "said"),
    [
        ({"channels": 2}, "Typed.channels must be 1 or 3, is 2"),
        ({"files": "mine.cl"}, "Typed.files must be a tuple of kernel files, is 'mine.cl'"),
        ({"files": ()}, "Typed.files must be a tuple"),
        ({"files": ("mine",)}, "has no kernel file 'mine', and those of your own end in .cl"),
        ({"files": (3,)}, "a name, a path or a KernelText is needed, not 3"),
        ({"inputs": ("place",)}, "Typed.inputs must be some of position, normal, outgoing"),
        ({"inputs": ("normal", "position")}, "in this order"),
        ({"inputs": ("normal",)}, "Typed.inputs must hold position"),
        ({"nested": True}, "only integrand gi can be nested"),
        ({"data": lambda self, scene: np.ones(3)}, "must return an array of float32, returned float64"),
        ({"data": lambda self, scene: [1, 2]}, "must return an array of float32, returned list"),
        ({"defines": lambda self, scene: {"A": 1}}, "super().defines(scene) does"),
        ({"defines": lambda self, scene: {"CHANNELS": 1, "VEC": 4}}, "the name VEC is taken"),
        (
            {"files": (KernelText("empty.cl", "/* void evaluate_integrand( */"),)},
            "empty.cl: void evaluate",
        ),
    ],
)
def test_a_class_that_is_no_integrand_is_refused(one_device, attributes, said):
    with pytest.raises(IntegrandError) as caught:
        ncv.render(floor(), typed(**attributes), "mc", **options(one_device))
    assert said in str(caught.value)


def test_a_class_without_what_is_needed_is_told_so(one_device):
    with pytest.raises(IntegrandError, match="Integrand does not say its name, files, channels, inputs"):
        ncv.render(floor(), ncv.Integrand(), "mc", **options(one_device))


def test_the_compilers_message_names_file_and_line(one_device, tmp_path, capfd):
    name = write(tmp_path, "  value[0] = undeclared;\n")
    with pytest.raises(RuntimeError) as caught:
        ncv.render(floor(), name, "mc", **options(one_device))
    # PoCL 3.0 prints some of the compiler's words instead of returning them.
    said = str(caught.value) + "".join(capfd.readouterr())
    assert f"{tmp_path / 'mine.cl'}:4:" in said and "undeclared" in said
    first = str(caught.value).splitlines()[0]
    assert first == f"{tmp_path / 'mine.cl'} cannot be compiled:" or first.startswith("building common")


def derived(kind, name, old, new, **attributes):
    """A class of one's own whose kernel is the shipped one with something changed."""
    text = kernel_files()[kind.name].read_text()
    assert old in text
    files = (*kind.files[:-1], ncv.KernelText(name, text.replace(old, new)))
    return type("Derived", (kind,), {"name": name, "files": files, **attributes})()


@pytest.mark.parametrize("visibility", ["auto", "points"])
def test_a_derived_class_inherits_no_promise_of_its_kernel(one_device, scenes, visibility):
    """Rays that end before the light, and half of ambient occlusion, are rendered as they are."""
    scene = scenes / "cornell_box.toml"
    short = derived(ncv.DirectLight, "short", "*distance = (real)1.0f;", "*distance = (real)0.3f;")
    half = derived(ncv.AmbientOcclusion, "half", "value[0] = ", "value[0] = 0.5f * ")
    for integrand in (short, half):
        found, traced = (
            ncv.render(scene, integrand, "mc", visibility=v, **options(one_device))
            for v in (visibility, "embree")
        )
        np.testing.assert_array_equal(found.pixels, traced.pixels)
        with pytest.raises(ValueError, match="'lines' is for"):
            ncv.render(scene, integrand, "mc", visibility="lines", **options(one_device))
