"""The contact problem of `trabecula-lab chart physics --peers` without time: minimises the chain's energy
with SciPy.

Input: a folder with contact.json; for the output lines see lab/charts/physics/contact.rs. It checks the
reference against which the others are compared, so it shares no code with them; its cost is not a time and is
given as 0.
"""
import json
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

problem = json.loads((Path(sys.argv[1]) / "contact.json").read_text())
k = np.array(problem["stiffness_nm_per_rad"])
length = np.array(problem["length_m"])
along = np.array(problem["sphere_along_m"])
radius, stiff = problem["sphere_radius_m"], problem["contact_stiffness_n_per_m"]


def place(angle, link, distance):
    """Returns a point of a link in the plane, and its derivative by every angle; a positive angle bends z
    toward x.
    """
    turned = np.cumsum(angle)
    ends = np.concatenate([[[0.0, problem["first_hinge_m"]]], np.zeros((link, 2))])
    for i in range(link):
        ends[i + 1] = ends[i] + length[i] * np.array([np.sin(turned[i]), np.cos(turned[i])])
    point = ends[link] + distance * np.array([np.sin(turned[link]), np.cos(turned[link])])
    slope = np.zeros((len(angle), 2))
    arm = point - ends
    slope[: link + 1] = np.column_stack([arm[:, 1], -arm[:, 0]])
    return point, slope


def energy(angle, walls, force):
    """Returns the energy, its gradient, and the part of its second derivative from the curvature of contacts
    and springs.
    """
    tip, slope = place(angle, len(angle) - 1, length[-1])
    value = 0.5 * k @ angle**2 - force * tip[0]
    gradient, second = k * angle - force * slope[:, 0], np.diag(k)
    for wall in walls:
        link = wall["link"]
        point, slope = place(angle, link, along[link])
        normal = np.array(wall["normal"])
        overlap = radius - normal @ (point - np.array(wall["point_m"]))
        if overlap > 0.0:
            value += 0.5 * stiff * overlap**2
            gradient = gradient - stiff * overlap * (slope @ normal)
            second = second + stiff * np.outer(slope @ normal, slope @ normal)
    return value, gradient, second


for walls in problem["cases"]:
    angle = np.zeros(len(k))
    for share in (0.25, 0.5, 0.75, 1.0):
        force = share * problem["tip_force_n"]
        found = minimize(
            lambda q: energy(q, walls, force)[:2], angle, jac=True, hess=lambda q: energy(q, walls, force)[2],
            method="trust-exact", options={"gtol": 1e-10, "maxiter": 2000})
        angle = found.x
    print("contact energy_minimum", len(walls), 1.0, 0.0, 0.0, *angle, flush=True)
