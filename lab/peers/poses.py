"""Shared by the scripts in this folder: the volume and the poses of `trabecula-lab chart drr`, and their
rendering.

Input: the folder with mu.raw and poses.json; for the output see lab/charts/drr/peers.rs.
"""
import json
import sys
import time
from pathlib import Path

import numpy as np

folder = Path(sys.argv[1])
plan = json.loads((folder / "poses.json").read_text())
threads_of_all = (1, 2)


def itk_volume():
    """Returns the volume as an ITK image; its origin is set by the caller."""
    import itk

    nx, ny, nz = plan["dims"]
    volume = itk.image_from_array(np.fromfile(folder / "mu.raw", dtype="<f4").reshape(nz, ny, nx))
    volume.SetSpacing(plan["spacing_mm"])
    return volume


def save(name, pose, threads, image):
    """Writes an image, millimetres of attenuation."""
    image.astype("<f4").tofile(folder / f"{name}_{pose['name']}_{threads}.raw")


def resampled(volume, make_caster, pose, threads, origin, axes=None):
    """Renders a pose with an ITK ray caster, an interpolator created by `make_caster`; prints the time of
    each round.
    """
    import itk

    image_type, pitch = type(volume), pose["pixel_pitch_mm"]
    for _ in range(plan["rounds"]):
        resample = itk.ResampleImageFilter[image_type, image_type].New()
        resample.SetInput(volume)
        resample.SetInterpolator(make_caster())
        resample.SetDefaultPixelValue(0)
        resample.SetSize([pose["columns"], pose["rows"], 1])
        resample.SetOutputSpacing([pitch[0], pitch[1], 1.0])
        resample.SetOutputOrigin(origin)
        if axes is not None:
            resample.SetOutputDirection(itk.matrix_from_array(axes))
        resample.SetNumberOfWorkUnits(threads)
        resample.GetMultiThreader().SetMaximumNumberOfThreads(threads)
        began = time.perf_counter()
        resample.Update()
        print(pose["name"], threads, (time.perf_counter() - began) * 1e3, flush=True)
        image = itk.array_from_image(resample.GetOutput())[0]
    return image
