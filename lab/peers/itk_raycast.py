"""ITK's bilinear ray caster (RayCastInterpolateImageFunction) on the volume and poses of `trabecula-lab chart
drr`: see poses.py.
"""
import itk
import numpy as np

from poses import itk_volume, plan, resampled, save, threads_of_all

volume = itk_volume()
volume.SetOrigin(plan["origin_mm"])
# It uses the volume's centre as the world origin, ignoring the image's origin.
middle = np.array(plan["origin_mm"]) + 0.5 * (np.array(plan["dims"]) - 1) * np.array(plan["spacing_mm"])

for pose in plan["poses"]:
    source, centre = np.array(pose["source_mm"]) - middle, np.array(pose["detector_centre_mm"]) - middle
    row, column = np.array(pose["row_axis"]), np.array(pose["column_axis"])
    columns, rows, pitch = pose["columns"], pose["rows"], pose["pixel_pitch_mm"]
    first = centre - (columns - 1) / 2 * pitch[0] * row - (rows - 1) / 2 * pitch[1] * column
    axes = np.stack([row, column, np.cross(row, column)], axis=1)

    def caster():
        caster = itk.RayCastInterpolateImageFunction[type(volume), itk.D].New()
        caster.SetFocalPoint(source.tolist())
        caster.SetTransform(itk.TranslationTransform[itk.D, 3].New())
        caster.SetThreshold(0.0)
        return caster

    for threads in threads_of_all:
        save("itk_raycast", pose, threads, resampled(volume, caster, pose, threads, first.tolist(), axes))
