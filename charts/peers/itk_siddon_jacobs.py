"""ITK's SiddonJacobsRayCastInterpolateImageFunction on the volume and poses of `trabecula chart drr`.

Input: the folder with mu.raw and poses.json; output as src/charts/drr/peers.rs says. The function takes the volume's corner for the
origin, brings points into the camera's frame by Rx(90 degrees) and the transform about its centre, and returns the integral divided by
the length of the ray.
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
spacing = np.array(plan["spacing_mm"])
corner = np.array(plan["origin_mm"]) - spacing / 2
volume = itk.image_from_array(np.fromfile(folder / "mu.raw", dtype="<f4").reshape(nz, ny, nx))
volume.SetSpacing(spacing.tolist())
image_type = type(volume)
quarter_turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])

for pose in plan["poses"]:
    row, column = np.array(pose["row_axis"]), np.array(pose["column_axis"])
    pitch, columns, rows = pose["pixel_pitch_mm"], pose["columns"], pose["rows"]
    source = np.array(pose["source_mm"]) - corner
    camera = np.array([row, column, np.cross(row, column)])
    # With the source as the centre and no distance to it, the camera's point is Rx(90 degrees) R (p - source).
    transform = itk.Euler3DTransform[itk.D].New()
    transform.SetCenter(source.tolist())
    transform.SetMatrix(itk.matrix_from_array(quarter_turn.T @ camera))
    first = camera @ (np.array(pose["detector_centre_mm"]) - corner - source)
    first -= [(columns - 1) / 2 * pitch[0], (rows - 1) / 2 * pitch[1], 0.0]
    x = first[0] + np.arange(columns) * pitch[0]
    y = first[1] + np.arange(rows) * pitch[1]
    length_mm = np.sqrt(x[None, :] ** 2 + y[:, None] ** 2 + first[2] ** 2)
    for threads in (1, 2):
        for _ in range(plan["rounds"]):
            caster = itk.SiddonJacobsRayCastInterpolateImageFunction[image_type, itk.D].New()
            caster.SetProjectionAngle(0.0)
            caster.SetFocalPointToIsocenterDistance(0.0)
            caster.SetThreshold(0.0)
            caster.SetTransform(transform)
            resample = itk.ResampleImageFilter[image_type, image_type].New()
            resample.SetInput(volume)
            resample.SetInterpolator(caster)
            resample.SetSize([columns, rows, 1])
            resample.SetOutputSpacing([pitch[0], pitch[1], 1.0])
            resample.SetOutputOrigin(first.tolist())
            resample.SetNumberOfWorkUnits(threads)
            resample.GetMultiThreader().SetMaximumNumberOfThreads(threads)
            began = time.perf_counter()
            resample.Update()
            print(pose["name"], threads, (time.perf_counter() - began) * 1e3, flush=True)
            image = itk.array_from_image(resample.GetOutput())[0]
        (image * length_mm).astype("<f4").tofile(folder / f"itk_siddon_jacobs_{pose['name']}_{threads}.raw")
