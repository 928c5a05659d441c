"""Writes the distances that ../distances.rs is checked against, by SciPy and trimesh:

    pip install scipy trimesh rtree
    python distances.py ../data

Two files: `torus.obj`, a closed mesh that is not convex, and `distances.csv`, 1,000 random points with
their signed distances from a set of voxels (SciPy's exact Euclidean distance transform of both sides,
less half of the shortest edge, interpolated linearly) and from the mesh (trimesh), all in mm.
"""

import sys
from pathlib import Path

import numpy as np
import trimesh
from scipy.ndimage import distance_transform_edt, map_coordinates

DIMS = np.array([44, 36, 30])
SPACING_MM = np.array([0.5, 0.6, 0.8])
POINTS = 1000


def voxels():
    """Two balls and a rod, as `is_inside` in ../distances.rs; the first axis is x."""
    place = np.stack(np.meshgrid(*map(np.arange, DIMS), indexing="ij"), axis=-1) * SPACING_MM
    ball = lambda centre, radius: np.sum((place - centre) ** 2, axis=-1) < radius**2
    rod = (np.abs(place[..., 1] - 12.0) < 1.3) & (np.abs(place[..., 2] - 15.0) < 1.3) & (place[..., 0] > 6.0)
    return (ball([7.0, 9.0, 10.0], 4.1) | ball([11.0, 12.0, 13.0], 3.2) | rod) & (place[..., 0] < 18.0)


def torus():
    """A torus of radii 9 and 3.5 mm."""
    mesh = trimesh.creation.torus(major_radius=9.0, minor_radius=3.5, major_sections=28, minor_sections=14)
    mesh.vertices = np.float32(mesh.vertices @ trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3].T)
    return mesh


def main(folder):
    mesh = torus()
    assert mesh.is_watertight
    with open(folder / "torus.obj", "w") as file:
        file.write("# SPACE=LPS\n")
        file.writelines("v {} {} {}\n".format(*(np.float32(x) for x in corner)) for corner in mesh.vertices)
        file.writelines("f {} {} {}\n".format(*(face + 1)) for face in mesh.faces)
    inside = voxels()
    field = distance_transform_edt(~inside, sampling=SPACING_MM) - distance_transform_edt(inside, sampling=SPACING_MM)
    field -= np.where(inside, -1.0, 1.0) * SPACING_MM.min() / 2
    random = np.random.default_rng(47)
    points = random.uniform(0.0, (DIMS - 1) * SPACING_MM, (POINTS, 3)).round(4)
    of_voxels = map_coordinates(field, (points / SPACING_MM).T, order=1)
    around = random.uniform(-15.0, 15.0, (POINTS, 3)).round(4)
    of_mesh = -trimesh.proximity.signed_distance(mesh, around)
    with open(folder / "distances.csv", "w") as file:
        file.write("x,y,z,of_voxels,u,v,w,of_mesh\n")
        for row in np.column_stack([points, of_voxels, around, of_mesh]):
            file.write(",".join(f"{value:.7g}" for value in row) + "\n")


main(Path(sys.argv[1]))
