"""3D Slicer's side of a plan, independent of Trabecula, with the PyPI packages `slicerio`, `trimesh` and `vtk`.

    plans.py plan FOLDER FRAME          curve.mrk.json, line.fcsv, deep.fcsv in FRAME (RAS or LPS); prints the targets in LPS
    plans.py segment CT SEG             CT's bone (150 HU and more) as the segment `hip bone` of the .seg.nrrd SEG
    plans.py read FOLDER                reads the exports of a run; prints figures of them
"""

import csv
import json
import sys
from pathlib import Path

import numpy as np
import slicerio

# The pilot hole of configs/pelvis_ct.toml, LPS: from the lateral cortex through the neck into the right
# femoral head.
ENTRY, BEND = np.array([-150.2, -135.1, 101.5]), np.array([-99.1, -143.6, 116.6])


def points():
    """A curve of 22 mm that turns by 40 degrees upward, a line of 40 mm, and one of 55 mm into the dense head."""
    along = (BEND - ENTRY) / np.linalg.norm(BEND - ENTRY)
    up = np.array([0.0, 0.0, 1.0])
    side = up - along * (up @ along)
    side /= np.linalg.norm(side)
    turn = np.radians(40.0)
    radius = 22.0 / turn
    target = BEND + radius * np.sin(turn) * along + radius * (1.0 - np.cos(turn)) * side
    return {"curve": {"Entry": ENTRY, "Bend": BEND, "Target": target}, "line": {"entry": ENTRY, "target": ENTRY + 40.0 * along},
            "deep": {"entry": ENTRY, "target": ENTRY + 55.0 * along}}


def plan(folder, frame):
    sign = np.array([-1.0, -1.0, 1.0]) if frame == "RAS" else np.ones(3)
    for name, named in points().items():
        rows = [
            f"{number},{x!r},{y!r},{z!r},0,0,0,1,1,1,0,{label},,"
            for number, (label, (x, y, z)) in enumerate(((l, (sign * p).tolist()) for l, p in named.items()), 1)
        ]
        head = ["# Markups fiducial file version = 4.11", f"# CoordinateSystem = {frame}",
                "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"]
        (folder / f"{name}.fcsv").write_text("\n".join(head + rows) + "\n")
    slicerio.fcsv_to_markups_json(folder / "curve.fcsv", folder / "curve.mrk.json")
    targets = {name: named[list(named)[-1]].tolist() for name, named in points().items()}
    print(json.dumps(targets))


def segment(ct, segmentation):
    volume = slicerio.read_volume(ct)
    made = slicerio.create_segmentation(volume["voxels"].shape, volume["ijkToLPS"])
    slicerio.add_segment(made, volume["voxels"] >= 150, {"name": "hip bone"})
    slicerio.write_segmentation(segmentation, made)
    print(json.dumps({"segments": slicerio.segment_names(slicerio.read_segmentation(segmentation))}))


def vtk_poly_data(path):
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    reader = vtkXMLPolyDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    return reader.GetOutput()


def vtk_volume(path):
    from vtkmodules.vtkFiltersCore import vtkMassProperties

    mass = vtkMassProperties()
    mass.SetInputData(vtk_poly_data(path))
    return mass.GetVolume()


def read(folder):
    import trimesh

    seen = {}
    for name in ("tunnel", "tool"):
        for ending in ("stl", "obj"):
            mesh = trimesh.load(folder / f"{name}.{ending}", force="mesh")
            seen[f"{name}.{ending}"] = {"volume_mm3": float(mesh.volume), "bounds_mm": mesh.bounds.tolist()}
        seen[f"{name}.vtp"] = {"volume_mm3": vtk_volume(folder / f"{name}.vtp")}
    curve = json.loads((folder / "burr.mrk.json").read_text())["markups"][0]
    seen["burr.mrk.json"] = {"frame": curve["coordinateSystem"], "type": curve["type"],
                             "last_mm": curve["controlPoints"][-1]["position"]}
    listed = slicerio.read_markups_fcsv(folder / "plan.fcsv")["markups"][0]
    seen["plan.fcsv"] = {"frame": listed["coordinateSystem"], "last_mm": listed["controlPoints"][-1]["position"]}
    coloured = vtk_poly_data(folder / "deviation.vtp")
    values = coloured.GetPointData().GetArray("deviation_mm")
    with open(folder / "deviation.csv", newline="") as table:
        rows = [float(row["deviation_mm"]) for row in csv.DictReader(table)]
    seen["deviation"] = {
        "lines": coloured.GetNumberOfLines(),
        "same": [values.GetValue(i) for i in range(values.GetNumberOfTuples())] == rows,
        "rows": len(rows),
        "last_mm": rows[-1],
    }
    drilled = slicerio.read_volume(folder / "drilled.nrrd")
    import nibabel

    nifti = nibabel.load(folder / "drilled.nii.gz")
    to_ras = np.diag([-1.0, -1.0, 1.0, 1.0]) @ drilled["ijkToLPS"]
    seen["drilled"] = {
        "air": int((drilled["voxels"] == -1000).sum()),
        "same_voxels": bool((np.asarray(nifti.dataobj) == drilled["voxels"]).all()),
        "apart_mm": float(np.abs(nifti.affine - to_ras).max()),
    }
    print(json.dumps(seen))


if __name__ == "__main__":
    command, *rest = sys.argv[1:]
    {"plan": lambda: plan(Path(rest[0]), rest[1]), "segment": lambda: segment(*rest), "read": lambda: read(Path(rest[0]))}[command]()
