"""plastimatch's exact projector (Siddon) on the volume and poses of `trabecula-lab chart drr`: see poses.py.

The time is that printed by the program for the projection alone, without reading and writing.
"""
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np

from poses import folder, plan, save, threads_of_all

program = Path(sys.executable).with_name("plastimatch")
volume = folder / "plastimatch.mha"
words = lambda values: " ".join(str(v) for v in values)
header = (
    "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\n"
    f"TransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = {words(plan['origin_mm'])}\n"
    f"ElementSpacing = {words(plan['spacing_mm'])}\nDimSize = {words(plan['dims'])}\n"
    "ElementType = MET_FLOAT\nElementDataFile = LOCAL\n"
)
volume.write_bytes(header.encode() + (folder / "mu.raw").read_bytes())

for pose in plan["poses"]:
    source, centre = np.array(pose["source_mm"]), np.array(pose["detector_centre_mm"])
    columns, rows, pitch = pose["columns"], pose["rows"], pose["pixel_pitch_mm"]
    distance = float(np.linalg.norm(source - centre))
    # The isocentre is freely chosen, here midway between source and detector. The normal points to the
    # source.
    normal = (source - centre) / distance
    middle = 0.5 * (source + centre)
    for threads in threads_of_all:
        for _ in range(plan["rounds"]):
            run = subprocess.run(
                [program, "drr", "-A", "cpu", "-i", "exact", "-P", "none", "-t", "raw",
                 "--nrm", words(normal), "--vup", words(-np.array(pose["column_axis"])),
                 "--sad", str(distance / 2), "--sid", str(distance), "-o", words(middle),
                 "-r", f"{rows} {columns}", "-z", f"{rows * pitch[1]} {columns * pitch[0]}",
                 "-c", f"{(rows - 1) / 2} {(columns - 1) / 2}",
                 "-O", str(folder / "plastimatch_"), str(volume)],
                env={**os.environ, "OMP_NUM_THREADS": str(threads)},
                capture_output=True, text=True, check=True)
            total, files = (
                float(re.search(rf"{what} time: ([0-9.e+-]+)", run.stdout)[1]) for what in ("Total", "I/O"))
            print(pose["name"], threads, (total - files) * 1e3, flush=True)
        # plastimatch integrates over centimetres, and its rows are in the opposite order.
        image = 10.0 * np.fromfile(
            folder / "plastimatch_0000.raw", dtype="<f4").reshape(rows, columns)[:, ::-1]
        save("plastimatch_exact", pose, threads, image)
