"""Reads a recording with the packages mcap and jsonschema, checks each message against the schema of its channel, and prints what
there is. A file without a summary was cut off, and is read up to its last chunk."""

import json
import struct
import sys

import jsonschema
from mcap.exceptions import EndOfFile, McapError
from mcap.reader import NonSeekingReader, make_reader


def messages(file, is_whole):
    reader = make_reader(file) if is_whole else NonSeekingReader(file)
    try:
        yield from reader.iter_messages(log_time_order=is_whole)
    except (EndOfFile, struct.error):
        assert not is_whole


def metadata(file, is_whole):
    reader = make_reader(file) if is_whole else NonSeekingReader(file)
    return next(dict(found.metadata) for found in reader.iter_metadata() if found.name == "cara")


def main():
    with open(sys.argv[1], "rb") as file:
        try:
            is_whole = make_reader(file).get_summary() is not None
        except McapError:
            is_whole = False
        file.seek(0)
        about = metadata(file, is_whole)
        file.seek(0)
        topics = {}
        for schema, channel, message in messages(file, is_whole):
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            jsonschema.validate(json.loads(message.data), json.loads(schema.data))
            topics[channel.topic] = topics.get(channel.topic, 0) + 1
    json.dump({"summary": is_whole, "topics": topics, "metadata": about}, sys.stdout)


main()
