"""ITK's Siddon-Jacobs ray caster on the volume and poses of `trabecula-lab chart drr`: see poses.py."""
import sys

import itk
import numpy as np

from poses import itk_volume, plan, resampled, save, threads_of_all

volume = itk_volume()
# It uses the volume's corner as the world origin, ignoring the image's origin.
corner = np.array(plan["origin_mm"]) - 0.5 * np.array(plan["spacing_mm"])

for pose in plan["poses"]:
    source, centre = np.array(pose["source_mm"]), np.array(pose["detector_centre_mm"])
    row, column = np.array(pose["row_axis"]), np.array(pose["column_axis"])
    columns, rows, pitch = pose["columns"], pose["rows"], pose["pixel_pitch_mm"]
    distance = float(np.linalg.norm(source - centre))
    to_source = (source - centre) / distance
    if not np.allclose(np.cross(to_source, row), column, atol=1e-9):
        sys.exit(f"{pose['name']}: only a detector seen from its own side can be cast")
    # Its camera is at the source and looks along -z, x along rows, y along columns; it turns by -90 degrees
    # about x last.
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

    def caster():
        caster = itk.SiddonJacobsRayCastInterpolateImageFunction[type(volume), itk.D].New()
        caster.SetFocalPointToIsocenterDistance(focal)
        caster.SetProjectionAngle(0.0)
        caster.SetThreshold(0.0)
        caster.SetTransform(transform)
        # Without this it keeps the pose of an identity and its images are empty.
        caster.Initialize()
        return caster

    for threads in threads_of_all:
        ratio = resampled(volume, caster, pose, threads, [float(u[0]), float(v[0]), -distance])
        save("itk_siddon_jacobs", pose, threads, ratio * length)
