"""Files of networks, checkpoints and layers: what is not as it must be is refused before it is used."""

from __future__ import annotations

import json
import os
import zipfile

import numpy as np
import pytest

from ncv_cl import integrate, render
from ncv_cl.cli import main
from ncv_cl.host.files import check_paths, check_writable, read_arrays, write_whole
from ncv_cl.learning.density import DensityNetwork
from ncv_cl.network.network import Network, NetworkError
from ncv_cl.output.checkpoint import Checkpoint, CheckpointError

OPTIONS = {"method": "ncv", "spp": 16, "train_spp": 4, "size": (12, 10), "seed": 3}


@pytest.fixture(scope="module")
def made(one_device, scenes, tmp_path_factory):
    """The arrays of a network's file and of a checkpoint, as a render writes them."""
    folder = tmp_path_factory.mktemp("made")
    files = {"save_network": folder / "network.npz", "checkpoint": folder / "checkpoint.npz"}
    render(scenes / "cornell_box.toml", "direct", device=one_device, **OPTIONS, **files)
    return {path.stem: read_arrays(path) for path in files.values()}


def with_json(arrays, name, keys, value):
    """The same arrays, one entry of the JSON text `name` replaced (or taken out: no value)."""
    about = json.loads(str(arrays[name]))
    entry = about
    for key in keys[:-1]:
        entry = entry[key]
    if value is ...:
        del entry[keys[-1]]
    else:
        entry[keys[-1]] = value
    return {**arrays, name: np.array(json.dumps(about))}


ENCODING = ("description", "encoding")


@pytest.mark.parametrize("value", ["4; rm -rf", "4", 4.0, 4.5, -1, 0, 1 << 40, True, None, [4], {}, ...])
@pytest.mark.parametrize(
    "keys",
    [
        *((*ENCODING, f"grid_{name}") for name in ("levels", "features", "base", "entries")),
        (*ENCODING, "blob_bins"),
        (*ENCODING, "inputs"),
        ("description", "channels"),
        ("description", "hidden"),
        ("description", "modulated"),
        ("cube", "lower"),
        ("description", "encoding"),
        ("description",),
        ("cube",),
    ],
    ids=".".join,
)
def test_a_networks_description_is_checked(made, tmp_path, keys, value):
    path = tmp_path / "network.npz"
    np.savez(path, **with_json(made["network"], "about", keys, value))
    with pytest.raises(NetworkError, match=r"network.npz is not a network") as raised:
        Network.load(path)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("description", "demodulated"), "yes"),
        (("description", "hidden"), [8, 8, 8]),
        (("description", "hidden"), [8, "8"]),
        (("description", "modulated"), ["W1", "W1"]),
        (("description", "modulated"), ["B1", "W1"]),
        (("description", "modulated"), ["W9"]),
        ((*ENCODING, "inputs"), ["normal"]),
        ((*ENCODING, "inputs"), ["position", "position"]),
        ((*ENCODING, "inputs"), ["position; x"]),
        ((*ENCODING, "grid_features"), 3),
        ((*ENCODING, "more"), 1),
        (("cube", "side"), 0),
        (("cube", "side"), float("inf")),
        (("cube", "side"), 1e39),
        (("cube", "lower"), [0, 0]),
        (("cube", "lower"), [0, 0, float("nan")]),
        (("cube", "lower"), [0, 0, "0"]),
    ],
)
def test_values_that_only_look_right_are_refused(made, tmp_path, keys, value):
    path = tmp_path / "network.npz"
    np.savez(path, **with_json(made["network"], "about", keys, value))
    with pytest.raises(NetworkError):
        Network.load(path)


def broken(array):
    """The same numbers as they must not be: another shape, another type, not finite."""
    yield array[:-1]
    yield array[None]
    yield array.astype(np.float64 if array.dtype != np.float64 else np.float32)
    yield array.astype("U8")
    if array.dtype.kind == "f":
        for value in (np.nan, np.inf):
            other = array.copy()
            other.flat[0] = value
            yield other


@pytest.mark.parametrize("loader", [Network, DensityNetwork])
@pytest.mark.parametrize("name", ["parameters", "table", "about"])
def test_a_networks_arrays_are_checked(made, tmp_path, name, loader):
    path, arrays = tmp_path / "network.npz", made["network"]
    cases = [np.array(1.0), np.array("{"), np.array("[]")] if name == "about" else broken(arrays[name])
    for case in [*cases, None]:
        others = {key: array for key, array in arrays.items() if key != name}
        np.savez(path, **others, **({} if case is None else {name: case}))
        with pytest.raises(NetworkError):
            loader.load(path)


@pytest.mark.parametrize("name", ["density_parameters", "density_features", "density_scalars"])
def test_a_densitys_arrays_are_checked(made, tmp_path, name):
    path, arrays = tmp_path / "network.npz", made["network"]
    cases = list(broken(arrays[name]))
    if name == "density_scalars":
        unit, hidden, share = arrays[name]
        cases += [
            np.array(case) for case in ([-1, hidden, share], [unit, 17, share], [unit, hidden, 0.0])
        ]
    for case in [*cases, None]:
        others = {key: array for key, array in arrays.items() if key != name}
        np.savez(path, **others, **({} if case is None else {name: case}))
        with pytest.raises(NetworkError):
            DensityNetwork.load(path)
    np.savez(path, **arrays)
    assert DensityNetwork.load(path) is not None


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("edges",), ...),
        (("edges",), [0, "8"]),
        (("edges",), [1, 8]),
        (("edges",), [0, 8, 8]),
        (("edges",), 8),
        (("edges",), []),
        (("method",), "auto"),
        (("method",), 3),
        (("identity",), None),
        (("prediction",), {}),
        (("prediction",), {"method": "ncv"}),
        (("more",), 1),
    ],
)
def test_what_a_checkpoint_says_is_checked(made, tmp_path, keys, value):
    path = tmp_path / "checkpoint.npz"
    np.savez(path, **with_json(made["checkpoint"], "checkpoint", keys, value))
    with pytest.raises(CheckpointError, match="is not a checkpoint"):
        Checkpoint.load(path)


def test_a_checkpoints_arrays_are_checked(one_device, scenes, made, tmp_path):
    path, arrays = tmp_path / "checkpoint.npz", made["checkpoint"]
    for name, array in arrays.items():
        if array.dtype.kind == "U":
            continue
        for case in broken(array):
            if name == "before_variance" and np.isnan(case.flat[0] if case.dtype.kind == "f" else 0):
                continue
            np.savez(path, **{**arrays, name: case})
            with pytest.raises(ValueError):
                render(scenes / "cornell_box.toml", device=one_device, **OPTIONS, resume=path)
    np.savez(path, **arrays)
    render(scenes / "cornell_box.toml", device=one_device, **OPTIONS, resume=path)


@pytest.mark.parametrize(
    "content", [b"", b"hello", b"PK", b"PK\x03\x04" + bytes(64), b"\x80\x04K\x00.", None]
)
def test_what_is_no_archive_is_refused_by_name(tmp_path, content):
    path = tmp_path / "file.npz"
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=r"file\.npz"):
        read_arrays(path)
    with pytest.raises(ValueError, match="there is no file"):
        read_arrays(tmp_path / "none.npz")


def test_archives_that_are_damaged_are_refused(made, tmp_path):
    """Cut anywhere, or with bytes changed: some error of a dozen classes becomes ours, none a result."""
    path = tmp_path / "file.npz"
    small = {name: array for name, array in made["network"].items() if name != "table"}
    for save in (np.savez, np.savez_compressed):
        save(path, **small)
        whole = path.read_bytes()
        generator = np.random.default_rng(0)
        for number in range(150):
            damaged = bytearray(whole)
            if number % 2:
                del damaged[generator.integers(len(whole)) :]
            else:
                # Within the headers of its members, where sizes and methods stand.
                place = whole.index(b"PK", generator.integers(len(whole) // 2)) + generator.integers(60)
                damaged[min(place, len(whole) - 1)] ^= 1 << generator.integers(8)
            path.write_bytes(damaged)
            try:
                found = read_arrays(path)
            except ValueError as error:
                assert "file.npz" in str(error)
            else:
                # What was hit does not matter to the arrays, or is the name of one.
                assert (
                    sum(
                        np.array_equal(a, b) for a, b in zip(found.values(), small.values(), strict=True)
                    )
                    > 2
                )


def test_archives_that_are_encrypted_or_packed_otherwise_are_refused(tmp_path):
    path = tmp_path / "file.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as file:
        file.writestr("a.npy", b"\x93NUMPY no header")
    with pytest.raises(ValueError, match=r"file\.npz cannot be read"):
        read_arrays(path)
    np.savez(path, a=np.array([{}], object))
    with pytest.raises(ValueError, match="allow_pickle=False"):
        read_arrays(path)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"weights0": np.ones(2)}, r"weights\[0\]"),
        ({"weights0": np.ones((3, 3))}, "layer 0 maps 2"),
        ({"weights0": np.array([["1", "2"], ["3", "4"]])}, "real numbers"),
        ({"weights0": np.ones((2, 2), complex)}, "real numbers"),
        ({"biases0": np.array([0.0, np.nan])}, "NaN"),
        ({"biases1": np.full(1, 1e300)}, "NaN or infinity"),
        ({"weights1": np.ones((5, 1, 2)), "biases1": np.ones((4, 1))}, "4 points, another array has 5"),
        ({"weights2": np.ones((1, 1))}, "no biases2"),
        ({"weights3": np.ones((1, 1))}, "weights3 is none of these"),
        ({"extra": np.ones(1)}, "extra is none of these"),
        ({"weights0": np.full((2, 2), 1e38), "weights1": np.full((1, 2), 1e38)}, "no finite result"),
    ],
)
def test_files_of_layers_are_checked(tmp_path, capsys, changed, said):
    layers = {
        "weights0": np.eye(2),
        "biases0": np.zeros(2),
        "weights1": np.ones((1, 2)),
        "biases1": np.zeros(1),
    }
    np.savez(tmp_path / "layers.npz", **layers | changed)
    assert main(["integrate", str(tmp_path / "layers.npz")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("ncv-cl: error: ")
    assert any(part in lines[0] for part in (said, said.replace("\\", "")))
    with pytest.raises(ValueError):
        integrate([np.ones((2, 2))], [np.ones(2), np.ones(2)])


def test_paths_are_checked_before_anything_is_written(tmp_path):
    (tmp_path / "file").write_text("old")
    for path, error in {
        tmp_path: IsADirectoryError,
        tmp_path / "none" / "a": FileNotFoundError,
        tmp_path / "file" / "a": NotADirectoryError,
        tmp_path / ("n" * 300): OSError,
        tmp_path / "a\0b": ValueError,
    }.items():
        with pytest.raises(error):
            check_writable(path)
    check_writable(tmp_path / "file")
    check_writable(os.devnull)
    with pytest.raises(ValueError, match="second would be written over first"):
        check_paths({"first": tmp_path / "a", "second": f"{tmp_path}/./a"})
    with pytest.raises(ValueError, match="over the scene"):
        check_paths({"output": tmp_path / "file"}, {"the scene": tmp_path / "file"})
    check_paths({"first": os.devnull, "second": os.devnull, "third": None}, {"none": None})
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / "file"
    write_whole(path, lambda file: file.write(b"first"))

    def fail(file):
        file.write(b"sec")
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match=r"cannot write .*file: No space left"):
        write_whole(path, fail)
    assert path.read_bytes() == b"first" and list(tmp_path.iterdir()) == [path]
    # As a file that is simply opened has them.
    (tmp_path / "plain").touch()
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode
    write_whole(os.devnull, lambda file: file.write(b"x"))
