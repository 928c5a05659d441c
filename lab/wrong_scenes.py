#!/usr/bin/env python3
"""Plans that go wrong, and random ones that do not: what `scene check --simulate` says about them.

    python3 lab/wrong_scenes.py target/release/trabecula [--right N]

80 wrong scenes, by the mistakes that people make: none may miss its target by more than 2 mm without a
warning. Then N random scenes (50): the last state, the tool, the plan and the drilling that are predicted
must be those of the run in lockstep. Prints a line for each; the exit code is 1 if one fails.
"""

import argparse
import json
import random
import subprocess
import sys
import tempfile
from pathlib import Path

MISS_MM = 2.0
BASE = {
    "duration_s": 2.6, "dt_ms": 1.0, "spacing_mm": 1.0, "threshold": "", "start": [1.0, -2.0, -34.0],
    "direction": [0.0, 0.0, 1.0], "bend": [1.0, 0.0, 0.0], "feed": 8.0, "insertion": 18.0, "tension": 6.0,
    "ramp_start": 1.0, "ramp_end": 15.0, "rpm": 8000.0, "more": "", "control": "", "target": None,
}


def text(scene):
    s = {**BASE, **scene}
    target = f"target_mm = {s['target']}\n" if s["target"] else ""
    return f"""
name = "wrong"
[run]
mode = "lockstep"
duration_s = {s['duration_s']}
dt_ms = {s['dt_ms']}
[volume]
phantom = "block"
spacing_mm = {s['spacing_mm']}
{s["threshold"]}
[tolerance]
path_deviation_mm = 4.0
[tool]
burr_start_mm = {s['start']}
direction = {s['direction']}
bend_toward = {s['bend']}
{s['more']}
[[controller]]
name = "reference"
drives = ["tendon", "arm", "burr"]
[controller.curved_drilling]
feed_mm_per_s = {s['feed']}
insertion_mm = {s['insertion']}
tension_n = {s['tension']}
ramp_start_mm = {s['ramp_start']}
ramp_end_mm = {s['ramp_end']}
burr_speed_rpm = {s['rpm']}
{s['control']}
{target}"""


class Program:
    def __init__(self, program, folder):
        self.program, self.folder, self.count = program, Path(folder), 0

    def call(self, scene, *words):
        """Runs a command with a scene; returns exit code, output and error output."""
        self.count += 1
        file = self.folder / f"{self.count}.toml"
        file.write_text(text(scene))
        words = [str(file) if word == "SCENE" else word for word in words]
        done = subprocess.run([self.program, *words], capture_output=True, text=True, timeout=1800)
        return done.returncode, done.stdout, done.stderr

    def check(self, scene):
        """Returns the prediction (None if the scene is refused) and the warnings."""
        code, out, err = self.call(scene, "scene", "check", "SCENE", "--simulate", "--json")
        if code == 2:
            return None, [err.strip()]
        if code != 0:
            sys.exit(f"scene check ended with {code}: {err}")
        said = json.loads(out)
        return said["prediction"], [finding["text"] for finding in said["findings"]]

    def run(self, scene):
        output = self.folder / f"out{self.count}"
        code, out, err = self.call(scene, "run", "SCENE", "--output", str(output), "--json")
        if code != 0:
            sys.exit(f"run ended with {code}: {err}")
        return json.loads(out.splitlines()[-1])["summary"]


def end_mm(program):
    """Where the burr of the base scene ends, from its distances to four targets."""
    middle, step = [1.0, -2.0, -24.0], 4.0
    places = [middle] + [[x + step * (axis == other) for other, x in enumerate(middle)] for axis in range(3)]
    far = [program.check({"target": place})[0]["tool"]["target_error_mm"] for place in places]
    away = [(far[0] ** 2 - far[axis + 1] ** 2 + step**2) / (2.0 * step) for axis in range(3)]
    return [x + more for x, more in zip(middle, away)]


def wrong():
    """The mistakes, each with its name."""
    each = lambda name, key, values: [(name, {key: value}) for value in values]
    lines = lambda name, key, form, values: [(name, {key: form.format(value)}) for value in values]
    truth = "[truth]\nregistration_error_mm = {}"
    return [
        *[("feed too long", {"insertion": mm, "duration_s": 8.0}) for mm in [22.0, 26.0, 30.0, 40.0, 52.0, 60.0]],
        *each("feed too short", "insertion", [3.0, 8.0, 12.0, 15.0]),
        *each("bends the wrong way", "bend", [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -2.0, 0.0]]),
        *each("points the wrong way", "direction", [[0.0, 0.0, -1.0], [0.0, 0.2, 1.0], [0.2, 0.0, 1.0], [-0.3, 0.0, 1.0], [0.0, 1.0, 0.2]]),
        *each("in RAS", "start", [[-1.0, 2.0, -34.0]]) + each("in RAS", "target", [[-9.0, 7.0, -16.0]]),
        *each("in metres or centimetres", "start", [[0.001, -0.002, -0.034], [0.1, -0.2, -3.4]]),
        *each("starts elsewhere", "start", [[4.0, -2.0, -34.0], [1.0, 6.0, -34.0], [1.0, -2.0, -38.0], [1.0, -2.0, -27.0], [16.0, -2.0, -34.0], [1.0, -2.0, 0.0]]),
        *each("tension", "tension", [0.0, 1.0, 2.0, 9.0, 12.0, 20.0, 40.0, 60.0]),
        *each("ramp beyond the feed", "ramp_end", [30.0, 45.0, 60.0]),
        *each("ramp too late", "ramp_start", [10.0, 14.0]),
        *each("burr off or slow", "rpm", [0.0, 10.0, 100.0, 500.0]),
        *each("feed too fast or slow", "feed", [0.5, 1.0, 2.0, 20.0, 50.0]),
        *each("duration", "duration_s", [0.5, 1.0, 1.5, 400.0]),
        *each("coarse voxels", "spacing_mm", [1.5, 2.0]),
        *each("coarse time", "dt_ms", [2.0, 5.0]),
        *lines("threshold", "threshold", "bone_threshold_hu = {}", [250, 299, 1000]),
        *lines("registration", "more", truth, ["[3.0, 0.0, 0.0]", "[0.0, 5.0, 0.0]", "[0.0, 0.0, 8.0]", "[-4.0, 4.0, 0.0]"]),
        *lines("turned", "more", "[truth]\nregistration_error_deg = {}", ["[0.0, 0.0, 40.0]", "[10.0, 0.0, 0.0]", "[0.0, -15.0, 0.0]"]),
        *lines("another tool", "more", "[truth.manipulator]\nstiffness_scale = {}", [0.3, 0.5, 2.0, 4.0]),
        *lines("gain", "control", "feedback = \"shape\"\nguidance_gain_n_per_mm = {}", [5.0, 10.0]),
        *lines("an arm that stops", "more", "[arm]\nmax_force_n = {}", [1.0, 5.0]),
        *lines("hard bone", "more", "[truth.drilling]\nspecific_energy_j_per_mm3 = {}", [1.0, 4.0]),
    ]


def right(count):
    """Random scenes of the kinds that work."""
    draw = random.Random(47)
    for number in range(count):
        yield {
            "duration_s": 1.5, "start": [draw.uniform(-3, 3), draw.uniform(-3, 3), draw.uniform(-35, -33)],
            "bend": [draw.uniform(0.5, 1.0), draw.uniform(-1.0, 1.0), 0.0], "feed": draw.uniform(4, 16),
            "insertion": draw.uniform(6, 15), "tension": draw.uniform(0, 9), "ramp_end": draw.uniform(5, 15),
            "control": "feedback = \"shape\"" if number % 5 == 4 else "",
            "more": ["", "[manipulator]\nmodel = \"full\"", "[truth.manipulator]\nstiffness_scale = 0.8"][number % 3],
        }


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("program", help="trabecula")
    arguments.add_argument("--right", type=int, default=50, help="number of random scenes")
    arguments = arguments.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        program = Program(arguments.program, folder)
        target = [round(x, 3) for x in end_mm(program)]
        prediction, warnings = program.check({"target": target})
        print(f"base: {prediction['tool']['target_error_mm']:.2f} mm off, {warnings}")
        failed += prediction["tool"]["target_error_mm"] > 0.01 or bool(warnings)
        scenes = wrong()
        for name, change in scenes:
            prediction, warnings = program.check({"target": target, **change})
            off_mm = prediction and prediction["tool"]["target_error_mm"]
            is_silent = not warnings and off_mm is not None and off_mm > MISS_MM
            failed += is_silent
            off = "refused" if off_mm is None else f"{off_mm:.2f} mm off"
            print(f"{'FAILED' if is_silent else 'ok':6} {name}: {off}, {len(warnings)} warnings {change}", flush=True)
            if off_mm is None:
                print(f"       {warnings[0][:200]}")
        for number, scene in enumerate(right(arguments.right)):
            prediction, _ = program.check(scene)
            summary = program.run(scene)
            differ = [key for key in ["final_hash", "tool", "plan", "drilling"] if prediction[key] != summary[key]]
            failed += bool(differ)
            print(f"{'FAILED' if differ else 'ok':6} right {number}: {summary['ticks']} ticks {differ}", flush=True)
    print(f"{len(scenes)} wrong and {arguments.right} right scenes, {failed} failed")
    sys.exit(1 if failed else 0)


main()
