"""A program on Slicer's side, independent of Trabecula, with the PyPI package `pyigtl`: it follows the tip, sends a plan,
takes an X-ray, pauses, resumes and stops the run. Arguments: port, token, target in RAS and mm. Prints its results as
JSON."""

import json
import sys
import time

import numpy as np
import pyigtl

LIMIT_S = 60.0


def until(what, found):
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end:
        value = found()
        if value is not None:
            return value
        time.sleep(0.01)
    raise SystemExit(f"no {what} within {LIMIT_S} s")


port, token = int(sys.argv[1]), sys.argv[2]
target_mm = np.array([float(value) for value in sys.argv[3:6]])
client = pyigtl.OpenIGTLinkClient(host="127.0.0.1", port=port)
newest = {}


def look():
    for message in client.get_latest_messages():
        newest[message.device_name] = message


def tip_mm():
    look()
    return newest["TipToRAS"].matrix[:3, 3] if "TipToRAS" in newest else None


def figures():
    look()
    text = newest["State"].string if "State" in newest else None
    return dict(pair.split("=") for pair in text.split()) if text else None


def say(name, text):
    client.send_message(pyigtl.StringMessage(text, device_name=name))


first_mm = until("tip", tip_mm)
scene = until("points of the scene", lambda: newest.get("Scene"))
seen = {"first_tip_mm": [float(v) for v in first_mm], "points": scene.names, "burr_start_mm": scene.positions[0]}

say("Command", "stop")
before = int(until("figures", figures)["tick"])
seen["ran_on_without_token"] = until("later tick", lambda: True if int(figures()["tick"]) > before + 200 else None)

say("Token", token)
client.send_message(pyigtl.PointMessage([list(target_mm)], names=["Target"], device_name="Plan"))
arrived_mm = until("arrival", lambda: tip_mm() if np.linalg.norm(tip_mm() - target_mm) < 0.3 else None)
seen["arrived_mm"] = [float(v) for v in arrived_mm]

# Lateral: +z toward the source along +x of RAS, rows down.
c_arm = np.array([[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, -20.0], [0.0, 0.0, 0.0, 1.0]])
client.send_message(pyigtl.TransformMessage(c_arm, device_name="CArmToRAS"))


def side_view():
    look()
    image = newest.get("XRayOnRequest")
    if image is None or abs(image.ijk_to_world_matrix[0, 2]) < 0.99:
        return None
    return image


image = until("X-ray from the side", side_view)
seen["image"] = {
    "shape": list(image.image.shape),
    "type": str(image.image.dtype),
    "range": [int(image.image.min()), int(image.image.max())],
    "ijk_to_ras": image.ijk_to_world_matrix.tolist(),
}

say("Command", "pause")
until("pause", lambda: True if figures()["phase"] == "paused" else None)
say("Command", "resume")
until("going on", lambda: True if figures()["phase"] == "running" else None)
say("Command", "stop")
until("end", lambda: True if not client.is_connected() or figures()["phase"] == "ended" else None)
print(json.dumps(seen))
client.stop()
