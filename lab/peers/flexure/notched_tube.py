"""Finite elements of the notched tube of `trabecula-lab chart flexure`: one flexure, and the middle one of
three.

Input: a folder with flexure.json (geometry in mm, Poisson's ratio, mesh sizes, number of flexures). Prints
one line per number of flexures and mesh: `stiffness FLEXURES SIZE_MM UNKNOWNS AXIAL SHEAR_TOWARD SHEAR_ACROSS
BENDING LATERAL TORSION`, for a modulus of 1 Pa, in N/m and N m/rad; then `chain ...` with the same figures
from the compliance of the whole sample: three flexures minus one (shear: nan).

The tube is cut by slots with round ends, alternately from -x and +x, past the axis. Between two slots remain
two webs at y = +-(mean radius). The lower end is clamped; the upper end is a rigid plate loaded by a force or
moment. Quadratic tetrahedra (gmsh), the half y >= 0 with symmetric or antisymmetric conditions, linear
elasticity and the solution by scikit-fem and SciPy.

A flexure's stiffness is force over the relative motion of the two adjacent half rings, at the middle of the
web. The motion of a half ring is the rigid motion that fits its nodes best in the least-squares sense, half a
tube radius or more away from the webs. Shear in the bending plane is a hundredth of the bending by the same
force over a pitch, so it is measured with a pair of forces along x at the height of the web, on the half
rings just behind the slots' ends, which causes no bending.
"""
import json
import sys
from pathlib import Path

import gmsh
import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as linalg
import skfem
from skfem.helpers import ddot, eye, sym_grad, trace

given = json.loads((Path(sys.argv[1]) / "flexure.json").read_text())
OUTER, INNER, WIDTH = given["outer_radius_mm"], given["inner_radius_mm"], given["notch_width_mm"]
PAST, PITCH, NU = given["notch_past_axis_mm"], given["pitch_mm"], given["poisson_ratio"]
# Height of the full ring at either end of the sample.
END = 2.0
# Loads: the component of (fx, fy, fz, mx, my, mz), its place in the printed line.
SYMMETRIC = {"shear_toward": 0, "axial": 2, "bending": 4}
ANTISYMMETRIC = {"shear_across": 1, "lateral": 3, "torsion": 5}
ORDER = ["axial", "shear_toward", "shear_across", "bending", "lateral", "torsion"]


def slots(flexures):
    """Returns height and side of each slot; the flexures are midway between them, the first one below."""
    first = -0.5 * flexures * PITCH
    return [(first + k * PITCH, -1 if k % 2 == 0 else 1) for k in range(flexures + 1)]


def mesh(flexures, size):
    gmsh.initialize()
    gmsh.option.setNumber("General.Verbosity", 1)
    gmsh.model.add("tube")
    occ = gmsh.model.occ
    top = 0.5 * flexures * PITCH + 0.5 * WIDTH + END
    tube = occ.addCylinder(0, 0, -top, 0, 0, 2 * top, OUTER)
    bore = occ.addCylinder(0, 0, -top, 0, 0, 2 * top, INNER)
    back = occ.addBox(-2 * OUTER, -2 * OUTER, -top, 4 * OUTER, 2 * OUTER, 2 * top)
    cut = [(3, bore), (3, back)]
    for z, side in slots(flexures):
        root = -side * (PAST - 0.5 * WIDTH)
        cut.append((3, occ.addCylinder(root, -1, z, 0, 2 * OUTER, 0, 0.5 * WIDTH)))
        left = root if side > 0 else -2 * OUTER
        cut.append((3, occ.addBox(left, -1, z - 0.5 * WIDTH, abs(root - side * 2 * OUTER), 2 * OUTER, WIDTH)))
    occ.cut([(3, tube)], cut)
    occ.synchronize()
    field = gmsh.model.mesh.field
    # Fine around the webs, coarse elsewhere.
    near = field.add("Box")
    for name, value in {
            "VIn": size, "VOut": 4 * size, "XMin": -1.2 * PAST - 0.3, "XMax": 1.2 * PAST + 0.3,
            "YMin": 0, "YMax": OUTER, "ZMin": -0.5 * flexures * PITCH - 0.2,
            "ZMax": 0.5 * flexures * PITCH + 0.2, "Thickness": 1.5}.items():
        field.setNumber(near, name, value)
    field.setAsBackgroundMesh(near)
    for option in ["MeshSizeExtendFromBoundary", "MeshSizeFromPoints", "MeshSizeFromCurvature"]:
        gmsh.option.setNumber("Mesh." + option, 0)
    gmsh.model.mesh.generate(3)
    tags, points, _ = gmsh.model.mesh.getNodes()
    place = np.zeros(int(tags.max()) + 1, dtype=int)
    place[tags.astype(int)] = np.arange(len(tags))
    kind = gmsh.model.mesh.getElementType("tetrahedron", 1)
    _, corners = gmsh.model.mesh.getElementsByType(kind)
    gmsh.finalize()
    points, corners = points.reshape(-1, 3).T, place[corners.astype(int)].reshape(-1, 4).T
    used, corners = np.unique(corners, return_inverse=True)
    return skfem.MeshTet(
        np.ascontiguousarray(points[:, used]), np.ascontiguousarray(corners.reshape(4, -1))), top


@skfem.BilinearForm
def elasticity(u, v, _):
    shear, lame = 0.5 / (1 + NU), NU / ((1 + NU) * (1 - 2 * NU))
    strain = sym_grad(u)
    return ddot(lame * eye(trace(strain), 3) + 2 * shear * strain, sym_grad(v))


def rigid(points, about):
    """Returns displacements of points for unit (ux, uy, uz, rotations about x, y, z) at `about`: 3 x points x
    6.
    """
    d = points - np.asarray(about)[:, None]
    out = np.zeros((3, points.shape[1], 6))
    for a in range(3):
        out[a, :, a] = 1
    out[1, :, 3], out[2, :, 3] = -d[2], d[1]
    out[0, :, 4], out[2, :, 4] = d[2], -d[0]
    out[0, :, 5], out[1, :, 5] = -d[1], d[0]
    return out


class Sample:
    def __init__(self, flexures, size):
        self.flexures = flexures
        tets, self.top = mesh(flexures, size)
        self.basis = skfem.Basis(tets, skfem.ElementVector(skfem.ElementTetP2()), intorder=2)
        self.stiffness = elasticity.assemble(self.basis)
        self.x = self.basis.doflocs
        self.unknowns = self.basis.N

    def component(self):
        # scikit-fem numbers the three components of a node one after the other.
        component = np.zeros(self.basis.N, dtype=int)
        for rows in [self.basis.nodal_dofs, self.basis.edge_dofs]:
            for a in range(3):
                component[rows[a]] = a
        return component

    def solve(self, loads, symmetric):
        """Returns displacements (unknowns x loads) and the plate's motion for unit loads at the middle of the
        sample.
        """
        component, x = self.component(), self.x
        plane = np.abs(x[1]) < 1e-9
        fixed = plane & (component == 1) if symmetric else plane & (component != 1)
        fixed |= x[2] < -self.top + 1e-9
        plate = np.flatnonzero(x[2] > self.top - 1e-9)
        # u = T (free unknowns, plate motion).
        modes = [loads[name] for name in loads]
        free = np.flatnonzero(~fixed & (x[2] <= self.top - 1e-9))
        motion = rigid(x[:, plate], [0, 0, 0])
        values = np.stack([motion[component[plate], np.arange(len(plate)), m] for m in modes], axis=1)
        t = sparse.lil_matrix((self.basis.N, len(free) + len(modes)))
        t[free, np.arange(len(free))] = 1
        t[plate[:, None], len(free) + np.arange(len(modes))[None, :]] = values
        t = t.tocsc()
        k = (t.T @ self.stiffness @ t).tocsc()
        right = np.zeros((k.shape[0], len(modes)))
        # Half the load on the half model.
        right[len(free) + np.arange(len(modes)), np.arange(len(modes))] = 0.5
        if symmetric:
            apart = self.apart()
            right = np.hstack([right, 0.5 * (t.T @ apart)[:, None]])
        solved = linalg.splu(
            k, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True},
            diag_pivot_thresh=0.01).solve(right)
        if symmetric:
            self.stretch = apart @ (t @ solved[:, -1])
        return t @ solved, solved[len(free):]

    def apart(self):
        """Returns the functional for the separation of the half rings along x just behind the ends of the
        middle web.
        """
        @skfem.LinearForm
        def on_side(v, w):
            x, _, z = w.x
            return v[0] * (
                (w.side * x > PAST) & (w.side * x < 2 * PAST) & (np.abs(z) < 0.5 * (PITCH - WIDTH)))

        along, component = [], self.component()
        for side in (1, -1):
            mean = on_side.assemble(self.basis, side=side)
            along.append(mean / mean[component == 0].sum())
        return along[0] - along[1]

    def body(self, u, z, side, modes, about):
        """Returns the rigid motion of the half ring at height z on a side (`modes` only, the others vanish by
        symmetry).
        """
        return self.nearest(
            u, (side * self.x[0] > 0.5 * OUTER) & (np.abs(self.x[2] - z) < 0.5 * PITCH), modes, about)

    def nearest(self, u, where, modes, about):
        x, component = self.x, self.component()
        inside = np.flatnonzero(where)
        motion = rigid(x[:, inside], about)
        a = np.stack([motion[component[inside], np.arange(len(inside)), m] for m in modes], axis=1)
        return np.linalg.lstsq(a, u[inside], rcond=None)[0]

    def middle(self):
        """Returns the compliance of the middle flexure by name, and the whole sample's."""
        own, whole = {}, {}
        at = slots(self.flexures)
        below, above = at[self.flexures // 2], at[self.flexures // 2 + 1]
        for loads, symmetric in [(SYMMETRIC, True), (ANTISYMMETRIC, False)]:
            u, plate = self.solve(loads, symmetric)
            modes = list(loads.values())
            for j, name in enumerate(loads):
                # A slot from -x leaves the half ring on +x.
                apart = self.body(u[:, j], above[0], -above[1], modes, [0, 0, 0]) - self.body(
                    u[:, j], below[0], -below[1], modes, [0, 0, 0])
                own[name], whole[name] = apart[j], plate[j, j]
            if symmetric:
                own["shear_toward"] = self.stretch
        return own, whole


def line(word, flexures, size, unknowns, stiffness):
    print(word, flexures, size, unknowns, *(f"{stiffness[name]:.6e}" for name in ORDER), flush=True)


def metres(name, compliance_mm):
    """Returns the stiffness for 1 Pa in N/m or N m/rad from a compliance in mm/N or rad/(N mm) at 1 MPa."""
    return 1e-6 * (1e3 if name in ("axial", "shear_toward", "shear_across") else 1e-3) / compliance_mm


for size in given["sizes_mm"]:
    whole = {}
    for flexures in given["flexures"]:
        sample = Sample(flexures, size)
        own, whole[flexures] = sample.middle()
        line("stiffness", flexures, size, sample.unknowns, {name: metres(name, own[name]) for name in ORDER})
    few, many = min(whole), max(whole)
    if many > few:
        per = {name: (whole[many][name] - whole[few][name]) / (many - few) for name in ORDER}
        # A shear force bends the flexures away from the middle: no shear stiffness follows from the whole
        # sample.
        per["shear_toward"] = per["shear_across"] = np.nan
        line("chain", many, size, 0, {name: metres(name, per[name]) for name in ORDER})
