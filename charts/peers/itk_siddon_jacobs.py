"""ITK's Siddon-Jacobs ray caster on the volume and poses of `trabecula chart drr`.

Input: the folder with mu.raw and poses.json; output as src/charts/drr/peers.rs says.
"""
import json
import sys
import time
from pathlib import Path

import itk
import numpy as np

folder = Path(sys.argv[1])
plan = json.loads((folder / "poses.json").read_text())
nx, ny, nz = plan["dims"]
spacing, origin = np.array(plan["spacing_mm"]), np.array(plan["origin_mm"])
volume = itk.image_from_array(np.fromfile(folder / "mu.raw", dtype="<f4").reshape(nz, ny, nx))
volume.SetSpacing(spacing.tolist())
# It takes the volume's corner for the world's origin, whatever the image says.
corner = origin - 0.5 * spacing
image_type = type(volume)

for pose in plan["poses"]:
    source, centre = np.array(pose["source_mm"]), np.array(pose["detector_centre_mm"])
    row, column = np.array(pose["row_axis"]), np.array(pose["column_axis"])
    columns, rows, pitch = pose["columns"], pose["rows"], pose["pixel_pitch_mm"]
    distance = float(np.linalg.norm(source - centre))
    to_source = (source - centre) / distance
    if not np.allclose(np.cross(to_source, row), column, atol=1e-9):
        sys.exit(f"{pose['name']}: only a detector seen from its own side can be cast")
    # Its camera is at the source and looks along -z, x along rows, y along columns; it turns by -90 degrees about x last.
    focal = distance / 2
    camera = np.array([row, column, to_source])
    back = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    transform = itk.Euler3DTransform[itk.D].New()
    transform.SetCenter((source - focal * to_source - corner).tolist())
    transform.SetMatrix(itk.matrix_from_array(back @ camera))
    # Distances from the source to the pixels: it divides by them.
    u = (np.arange(columns) - (columns - 1) / 2) * pitch[0]
    v = (np.arange(rows) - (rows - 1) / 2) * pitch[1]
    length = np.sqrt(distance**2 + u[None, :] ** 2 + v[:, None] ** 2)
    for threads in (1, 2):
        for _ in range(plan["rounds"]):
            caster = itk.SiddonJacobsRayCastInterpolateImageFunction[image_type, itk.D].New()
            caster.SetFocalPointToIsocenterDistance(focal)
            caster.SetProjectionAngle(0.0)
            caster.SetThreshold(0.0)
            caster.SetTransform(transform)
            # Without this it keeps the pose of an identity and its images are empty.
            caster.Initialize()
            resample = itk.ResampleImageFilter[image_type, image_type].New()
            resample.SetInput(volume)
            resample.SetInterpolator(caster)
            resample.SetDefaultPixelValue(0)
            resample.SetSize([columns, rows, 1])
            resample.SetOutputSpacing([pitch[0], pitch[1], 1.0])
            resample.SetOutputOrigin([float(u[0]), float(v[0]), -distance])
            resample.SetNumberOfWorkUnits(threads)
            resample.GetMultiThreader().SetMaximumNumberOfThreads(threads)
            began = time.perf_counter()
            resample.Update()
            print(pose["name"], threads, (time.perf_counter() - began) * 1e3, flush=True)
            ratio = itk.array_from_image(resample.GetOutput())[0]
        (ratio * length).astype("<f4").tofile(folder / f"itk_siddon_jacobs_{pose['name']}_{threads}.raw")
