"""RTK's Joseph forward projector on the volume and poses of `trabecula-lab chart drr`: see poses.py."""
import itertools
import sys
import time

import itk
import numpy as np
from itk import RTK as rtk

from poses import itk_volume, plan, save, threads_of_all

volume = itk_volume()
volume.SetOrigin(plan["origin_mm"])
image_type = type(volume)

for pose in plan["poses"]:
    row, column = np.array(pose["row_axis"]), np.array(pose["column_axis"])
    pitch, columns, rows = pose["pixel_pitch_mm"], pose["columns"], pose["rows"]
    geometry = rtk.ThreeDCircularProjectionGeometry.New()
    # A general pose: source, detector origin, and the directions of column and row indices.
    source, centre = np.array(pose["source_mm"]), np.array(pose["detector_centre_mm"])
    ok = geometry.AddProjection(
        itk.Point[itk.D, 3](source.tolist()), itk.Point[itk.D, 3](centre.tolist()),
        itk.Vector[itk.D, 3](row.tolist()), itk.Vector[itk.D, 3](column.tolist()))
    if not ok:
        sys.exit(f"RTK refuses the pose {pose['name']}")
    # RTK's projection matrix (world to detector, millimetres) must project points like the chart's geometry.
    matrix = itk.array_from_matrix(geometry.GetMatrix(0))
    for point in itertools.product((-100.0, 0.0, 100.0), repeat=3):
        u, v, w = matrix @ [*point, 1.0]
        ray = np.array(point) - source
        normal = np.cross(row, column)
        hit = source + ray * (normal @ (centre - source)) / (normal @ ray) - centre
        differences = (u / w - hit @ row) / pitch[0], (v / w - hit @ column) / pitch[1]
        if max(map(abs, differences)) > 1e-6:
            sys.exit(f"{pose['name']}: RTK sees {point} {differences} pixel away")
    for threads in threads_of_all:
        for _ in range(plan["rounds"]):
            blank = itk.image_from_array(np.zeros((1, rows, columns), dtype="<f4"))
            blank.SetSpacing([pitch[0], pitch[1], 1.0])
            blank.SetOrigin([-(columns - 1) / 2 * pitch[0], -(rows - 1) / 2 * pitch[1], 0.0])
            projector = rtk.JosephForwardProjectionImageFilter[image_type, image_type].New()
            projector.SetInput(0, blank)
            projector.SetInput(1, volume)
            projector.SetGeometry(geometry)
            projector.SetNumberOfWorkUnits(threads)
            projector.GetMultiThreader().SetMaximumNumberOfThreads(threads)
            began = time.perf_counter()
            projector.Update()
            print(pose["name"], threads, (time.perf_counter() - began) * 1e3, flush=True)
            image = itk.array_from_image(projector.GetOutput())
        save("rtk_joseph", pose, threads, image)
