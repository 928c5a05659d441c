"""Does what Lichtblick would do with a viewer, without Lichtblick: connects, finds the layout's topics, decodes their
messages by the advertised schemas, and checks the 3D scene against Foxglove's published schema.

    client.py ws://HOST:PORT/ws LAYOUT.json TOKEN
"""

import json
import re
import struct
import sys

from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.json_format import ParseDict
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from websockets.sync.client import ClientConnection, connect

LIMIT_S = 30


class Viewer:
    """A connection and its advertised channels."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        assert self.socket.subprotocol == "foxglove.sdk.v1"
        info = self.text("serverInfo")
        assert {"time", "services"} <= set(info["capabilities"]) and "json" in info["supportedEncodings"], info
        self.channels = {channel["topic"]: channel for channel in self.text("advertise")["channels"]}
        self.services = {service["name"]: service["id"] for service in self.text("advertiseServices")["services"]}

    def text(self, op: str) -> dict:
        message = json.loads(self.socket.recv(LIMIT_S))
        assert message["op"] == op, message
        return message

    def seek(self, token: str, time_ns: int) -> None:
        """Moves the time line by a service call."""
        encoding, body = b"json", json.dumps({"token": token, "action": "seek", "time_ns": time_ns}).encode()
        self.socket.send(struct.pack("<BIII", 2, self.services["/playback"], 1, len(encoding)) + encoding + body)

    def newest(self, topics: list[str]) -> dict[str, bytes]:
        """Subscribes and receives the first message of each topic."""
        wanted = {100 + number: topic for number, topic in enumerate(topics)}
        subscriptions = [{"id": number, "channelId": self.channels[topic]["id"]} for number, topic in wanted.items()]
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
        found: dict[str, bytes] = {}
        while len(found) < len(topics):
            message = self.socket.recv(LIMIT_S)
            if isinstance(message, bytes) and message[0] == 1:
                number, _time_ns = struct.unpack_from("<IQ", message, 1)
                found.setdefault(wanted[number], message[13:])
            elif isinstance(message, str):
                raise AssertionError(message)
        return found

    def decode(self, topic: str, payload: bytes) -> object:
        channel = self.channels[topic]
        assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg"), channel
        schema = Schema(id=1, name=channel["schemaName"], encoding="ros2msg", data=channel["schema"].encode())
        return DecoderFactory().decoder_for("cdr", schema)(payload)


def paths_of(layout: dict) -> tuple[set[str], set[str]]:
    """Returns the topics and message paths that the layout's panels show."""
    topics, paths = set(), set()
    for name, panel in layout["configById"].items():
        kind = name.split("!")[0]
        if kind == "Image":
            topics.add(panel["imageMode"]["imageTopic"])
        elif kind == "3D":
            topics.update(topic for topic, settings in panel["topics"].items() if settings["visible"])
        elif kind == "RawMessages":
            topics.add(panel["topicPath"])
        elif kind == "Plot":
            paths.update(path["value"] for path in panel["paths"])
        else:
            raise AssertionError(f"a panel of the kind {kind}")
    return topics, paths


def panels_of(layout: dict | str) -> set[str]:
    """Returns the panels that the layout places."""
    return {layout} if isinstance(layout, str) else panels_of(layout["first"]) | panels_of(layout["second"])


def value_at(message: object, path: str) -> float:
    """Returns the number at a path such as `t_world_tip.position_m[0]`."""
    for part in path.split("."):
        name, *indices = re.split(r"[\[\]]+", part.rstrip("]"))
        message = getattr(message, name)
        for index in indices:
            message = message[int(index)]
    assert isinstance(message, (int, float)), (path, message)
    return message


def check_scene(update: dict) -> None:
    """The 3D scene is a SceneUpdate in JSON, whose times are {sec, nsec} where protobuf's JSON has text."""
    def as_protobuf(value: object) -> object:
        if isinstance(value, dict) and value.keys() == {"sec", "nsec"}:
            return f"{value['sec']}.{value['nsec']:09}s"
        if isinstance(value, dict):
            return {key: as_protobuf(one) for key, one in value.items()}
        return [as_protobuf(one) for one in value] if isinstance(value, list) else value

    entities = update["entities"]
    for entity in entities:
        assert entity["timestamp"]["nsec"] < 1_000_000_000
        del entity["timestamp"]  # a Timestamp's text is a date, not a duration
    # Rejects fields, types and codes that the published schema does not have.
    parsed = ParseDict(as_protobuf(update), SceneUpdate())
    tool = next(entity for entity in parsed.entities if entity.id == "tool")
    assert tool.frame_id == "world" and len(tool.spheres) == 1 and len(tool.cylinders) > 3, tool
    lengths = [cylinder.size.z for cylinder in tool.cylinders]
    assert all(0.0 < length < 0.2 for length in lengths), lengths
    for shape in [*tool.spheres, *tool.cylinders]:
        q = shape.pose.orientation
        assert abs(q.x**2 + q.y**2 + q.z**2 + q.w**2 - 1.0) < 1e-9
    # A line strip's points come in pairs: the contact, and the tip of its force.
    assert all(len(line.points) == 2 for line in tool.lines)


def main() -> None:
    url, file, token = sys.argv[1:]
    with open(file, encoding="utf-8") as text:
        layout = json.load(text)
    assert panels_of(layout["layout"]) == set(layout["configById"]), "panels without a place or a configuration"
    with connect(url, subprotocols=["foxglove.sdk.v1"], max_size=None) as socket:
        check(Viewer(socket), layout, token)


def check(viewer: Viewer, layout: dict, token: str) -> None:
    """Checks that everything in the layout is advertised and matches its schema."""
    topics, paths = paths_of(layout)
    topic_of = {path: path.split(".")[0] for path in paths}
    shown = sorted(topics | set(topic_of.values()))
    missing = [topic for topic in shown if topic not in viewer.channels]
    assert not missing, f"the layout shows topics that nobody advertises: {missing}"
    viewer.seek(token, 300_000_000)
    messages = viewer.newest(shown)
    scene = viewer.channels["/view/scene"]
    assert (scene["schemaName"], scene["encoding"], scene["schemaEncoding"]) == ("foxglove.SceneUpdate", "json", "jsonschema")
    check_scene(json.loads(messages.pop("/view/scene")))
    decoded = {topic: viewer.decode(topic, payload) for topic, payload in messages.items()}
    for path, topic in sorted(topic_of.items()):
        print(path, value_at(decoded[topic], path.removeprefix(f"{topic}.")))
    image = decoded["/drr/image"]
    assert viewer.channels["/drr/image"]["schemaName"] == "sensor_msgs/msg/Image"
    assert image.encoding == "mono16" and len(image.data) == image.height * image.step == image.height * image.width * 2
    print(f"ok {len(shown)} topics, {len(paths)} paths")


if __name__ == "__main__":
    main()
