"""Decodes a log with mcap-ros2-support and prints every scalar as `topic message path bits`, one a line.

Floats are printed as the hexadecimal bits of their IEEE 754 double, strings in quotes, so that nothing is rounded.
"""

import struct
import sys

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory


def show(prefix, path, value):
    if isinstance(value, bool):
        print(prefix, path, int(value))
    elif isinstance(value, int):
        print(prefix, path, value)
    elif isinstance(value, float):
        print(prefix, path, struct.pack(">d", value).hex())
    elif isinstance(value, str):
        print(prefix, path, '"' + value + '"')
    elif isinstance(value, (list, tuple, bytes, bytearray, memoryview)):
        for index, item in enumerate(value):
            show(prefix, f"{path}[{index}]", item)
    else:
        for name in value.__slots__:
            show(prefix, f"{path}.{name}" if path else name, getattr(value, name))


def main():
    counts = {}
    with open(sys.argv[1], "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for _schema, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
            number = counts.get(channel.topic, 0)
            counts[channel.topic] = number + 1
            print(channel.topic, number, "log_time", message.log_time)
            show(f"{channel.topic} {number}", "", decoded)
        for name in sorted(m.name for m in reader.iter_metadata()):
            print("metadata", name)
        for attachment in reader.iter_attachments():
            print("attachment", attachment.name, len(attachment.data))


main()
