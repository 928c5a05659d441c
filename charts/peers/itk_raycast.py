"""ITK's bilinear ray caster (RayCastInterpolateImageFunction) on the volume and poses of `trabecula chart drr`.

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
volume = itk.image_from_array(np.fromfile(folder / "mu.raw", dtype="<f4").reshape(nz, ny, nx))
spacing = np.array(plan["spacing_mm"])
volume.SetSpacing(spacing.tolist())
volume.SetOrigin(plan["origin_mm"])
# It takes the volume's middle for the world's origin, whatever the image says.
middle = np.array(plan["origin_mm"]) + 0.5 * (np.array(plan["dims"]) - 1) * spacing
image_type = type(volume)

for pose in plan["poses"]:
    source, centre = np.array(pose["source_mm"]) - middle, np.array(pose["detector_centre_mm"]) - middle
    row, column = np.array(pose["row_axis"]), np.array(pose["column_axis"])
    columns, rows, pitch = pose["columns"], pose["rows"], pose["pixel_pitch_mm"]
    first = centre - (columns - 1) / 2 * pitch[0] * row - (rows - 1) / 2 * pitch[1] * column
    axes = np.stack([row, column, np.cross(row, column)], axis=1)
    for threads in (1, 2):
        for _ in range(plan["rounds"]):
            caster = itk.RayCastInterpolateImageFunction[image_type, itk.D].New()
            caster.SetFocalPoint(source.tolist())
            caster.SetTransform(itk.TranslationTransform[itk.D, 3].New())
            caster.SetThreshold(0.0)
            resample = itk.ResampleImageFilter[image_type, image_type].New()
            resample.SetInput(volume)
            resample.SetInterpolator(caster)
            resample.SetDefaultPixelValue(0)
            resample.SetSize([columns, rows, 1])
            resample.SetOutputSpacing([pitch[0], pitch[1], 1.0])
            resample.SetOutputOrigin(first.tolist())
            resample.SetOutputDirection(itk.matrix_from_array(axes))
            resample.SetNumberOfWorkUnits(threads)
            resample.GetMultiThreader().SetMaximumNumberOfThreads(threads)
            began = time.perf_counter()
            resample.Update()
            print(pose["name"], threads, (time.perf_counter() - began) * 1e3, flush=True)
            image = itk.array_from_image(resample.GetOutput())[0]
        image.astype("<f4").tofile(folder / f"itk_raycast_{pose['name']}_{threads}.raw")
