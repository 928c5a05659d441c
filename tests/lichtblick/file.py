"""Does what Lichtblick would do with an exported file, without Lichtblick: reads it with the MCAP project's reader and
ROS 2 decoder, finds what the layout shows, and checks the 3D scene against Foxglove's published schema.

    file.py VIEW.mcap LAYOUT.json
"""

import json
import sys

from client import check_scene, paths_of, value_at
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

# Topics of the timing log, which an exported run does not contain.
ELSEWHERE = ("/timing/", "/event", "/run/")


def main() -> None:
    file, layout_file = sys.argv[1:]
    with open(layout_file, encoding="utf-8") as text:
        topics, paths = paths_of(json.load(text))
    with open(file, "rb") as data:
        messages = [(schema, channel, message) for schema, channel, message in make_reader(data, validate_crcs=True).iter_messages()]
    decoders = {}
    by_topic: dict[str, list] = {}
    for schema, channel, message in messages:
        if channel.message_encoding == "json":
            assert schema.name == "foxglove.SceneUpdate" and schema.encoding == "jsonschema", schema
            value = json.loads(message.data)
        else:
            assert (channel.message_encoding, schema.encoding) == ("cdr", "ros2msg"), channel
            decode = decoders.setdefault(channel.id, DecoderFactory().decoder_for("cdr", schema))
            value = decode(message.data)
        by_topic.setdefault(channel.topic, []).append((message.log_time, value))
    wanted = topics | {path.split(".")[0] for path in paths}
    missing = [topic for topic in wanted if topic not in by_topic and not topic.startswith(ELSEWHERE)]
    assert not missing, f"the layout shows topics that the file has not: {missing}"
    for path in paths:
        topic = path.split(".")[0]
        if topic in by_topic:
            value_at(by_topic[topic][-1][1], path.removeprefix(f"{topic}."))
    check_poses(dict(by_topic["/state"]), by_topic["/tf"])
    check_scenes([update for _, update in by_topic["/view/scene"]])
    image = by_topic["/drr/image"][0][1]
    assert image.encoding == "mono16" and len(image.data) == image.height * image.width * 2
    print(f"ok {len(by_topic['/state'])} states, {len(by_topic['/drr/image'])} images, {len(by_topic['/view/scene'])} scenes")


def check_poses(states: dict, transforms: list) -> None:
    """Checks that each `/tf` matches the state of its time."""
    assert len(transforms) == len(states) > 1
    for log_time, message in transforms:
        state = states[log_time]
        found = {one.child_frame_id: one for one in message.transforms}
        assert set(found) == {"flange", "base", "burr", "tip"}, set(found)
        for name, one in found.items():
            pose = getattr(state, f"t_world_{name}")
            assert one.header.frame_id == "world" and one.header.stamp.sec * 10**9 + one.header.stamp.nanosec == log_time
            place, turn = one.transform.translation, one.transform.rotation
            assert [place.x, place.y, place.z] == list(pose.position_m), name
            assert [turn.x, turn.y, turn.z, turn.w] == list(pose.orientation_xyzw), name


def check_scenes(updates: list) -> None:
    """Checks the tool at every time, the planned path once, and the growing path of the burr."""
    ids = [entity["id"] for update in updates for entity in update["entities"]]
    assert ids.count("planned path") == 1 and ids.count("burr path") >= 2, set(ids)
    lengths = [len(entity["lines"][0]["points"]) for update in updates for entity in update["entities"] if entity["id"] == "burr path"]
    assert lengths == sorted(lengths) and lengths[-1] > lengths[0], lengths
    for update in updates:
        if update["entities"][0]["id"] == "tool":
            check_scene(update)


if __name__ == "__main__":
    main()
