"""Message records of a chunk, each written in one go: a flight has dozens of messages in every slot."""

from __future__ import annotations

import struct
from functools import partial
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Message, MessageIndex
from mcap.writer import Writer

_ATTRIBUTE = "_Writer__chunk_builder"  # of mcap's writer
_NEEDED = ("message_start_time", "message_end_time", "message_indices", "num_messages", "record_writer")
# Opcode, length, channel, sequence, log time, publish time; the message's bytes follow.
_RECORD = struct.Struct("<BQHIQQ")
_COUNTED = _RECORD.size - 9  # bytes that the length counts beside the message's


def write_quickly(writer: Writer) -> None:
    """Lets a writer put messages into its chunks in one go; it would write number by number.

    :param writer: mcap's writer; one that makes chunks in another way is left as it is.
    """
    builder = getattr(writer, _ATTRIBUTE, None)
    if all(hasattr(builder, name) for name in _NEEDED):
        builder.add_message = partial(_add_message, builder)


def _add_message(builder: Any, message: Message) -> None:
    """Does what the chunk builder's own method does."""
    time_ns, channel, data = message.log_time, message.channel_id, message.data
    if not builder.num_messages or time_ns < builder.message_start_time:
        builder.message_start_time = time_ns
    if time_ns > builder.message_end_time:
        builder.message_end_time = time_ns
    index = builder.message_indices.get(channel)
    if index is None:
        index = builder.message_indices[channel] = MessageIndex(channel_id=channel, records=[])
    record = builder.record_writer
    index.records.append((time_ns, record.count))
    builder.num_messages += 1
    length = _COUNTED + len(data)
    record.write(_RECORD.pack(Opcode.MESSAGE, length, channel, message.sequence, time_ns, message.publish_time))
    record.write(data)
