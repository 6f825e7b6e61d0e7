"""The command `ncv-cl sense`: files of points, of values, and what is wrong with them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

import ncv_cl as ncv
from ncv_cl.cli import main

HEADER = "x,y,z,nx,ny,nz"
ROWS = ["0,0.5,0,0,1,0", "0.25,0.5,0,0,0,1"]


@pytest.mark.parametrize("form", ["csv", "npy", "ply"])
def test_sense_reads_and_writes_files(scenes, one_device, tmp_path, capsys, form):
    rows = np.array([[float(cell) for cell in row.split(",")] for row in ROWS])
    points, out = tmp_path / f"points.{form}", tmp_path / f"out.{form}"
    if form == "csv":
        # Columns by name, in another order, with one more.
        points.write_text("# sensors\nnz,id,x,y,z,nx,ny\n0,7,0,0.5,0,0,1\n\n1,8,0.25,0.5,0,0,0\n")
    elif form == "npy":
        np.save(points, rows)
    else:
        vertex = np.array([tuple(row) for row in rows], [(name, "f8") for name in HEADER.split(",")])
        PlyData([PlyElement.describe(vertex, "vertex")]).write(str(points))
    scene = str(scenes / "interior.toml")
    arguments = ["sense", scene, str(points), "-o", str(out), "--spp", "16", "--device",
                 str(one_device.index), "--json", str(tmp_path / "a.json")]  # fmt: skip
    assert main(arguments) == 0
    assert "2 points" in capsys.readouterr().out
    expected = ncv.irradiance(scene, rows[:, :3], rows[:, 3:], spp=16, device=one_device)
    if form == "npy":
        table = np.load(out)
    elif form == "csv":
        head, *lines = out.read_text().splitlines()
        assert head == f"{HEADER},R,G,B,R_error,G_error,B_error"
        table = np.array([[float(cell) for cell in line.split(",")] for line in lines])
    else:
        vertices = PlyData.read(str(out))["vertex"]
        table = np.stack([vertices[one.name] for one in vertices.properties], axis=1)
    wanted = np.concatenate([rows, expected.values, expected.standard_error], axis=1)
    assert np.array_equal(table, wanted)
    stats = json.loads((tmp_path / "a.json").read_text())
    assert stats["points"] == 2 and stats["points_detached"] == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0,0,0,0,1", "line 1 has 5 numbers"),
        (f"{HEADER}\n0,0,0,0,1,x", "line 2"),
        ("x,y,z,nx,ny\n", "no column nz"),
    ],
)
def test_sense_says_where_a_file_is_wrong(scenes, tmp_path, capsys, text, message):
    points = tmp_path / "points.csv"
    points.write_text(text)
    scene = str(scenes / "interior.toml")
    assert main(["sense", scene, str(points), "-o", str(tmp_path / "out.csv")]) == 2
    assert message in capsys.readouterr().err
    assert main(["sense", scene, str(tmp_path / "none.npy"), "-o", str(tmp_path / "out.csv")]) == 2
    assert main(["sense", scene, str(points), "-o", str(tmp_path / "out.txt")]) == 2
    assert main(["sense", scene, str(points), "-o", str(points)]) == 2
    points.write_text(HEADER)
    assert main(["sense", scene, str(points), "-o", str(tmp_path / "out.csv")]) == 0
    assert (tmp_path / "out.csv").read_text().startswith(HEADER)
