"""What a bag says of its run, where several copies have to agree.

No checksum of MCAP covers a metadata record, nor metadata.yaml. Bags of netpos say the same in
two records and in metadata.yaml, newer ones also in attachments, which carry a checksum.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from netpos.bags import layout
from netpos.common.yaml_text import YamlError, load_yaml

Run = dict[str, str]


def texts(custom: Mapping[Any, Any]) -> Run:
    """Keys and values as text."""
    return {str(key): str(value) for key, value in custom.items()}


def run_of_description(text: str) -> Run | None:
    """What metadata.yaml, or its copy in the file, says of the run; None where it cannot be
    read."""
    try:
        found = load_yaml(text)
        found = found.get("rosbag2_bagfile_information", found)
        return texts(found["custom_data"] or {})
    except (YamlError, KeyError, AttributeError):
        return None


def agreed(copies: Sequence[Run]) -> tuple[Run, list[str]]:
    """What at least two copies say alike, and the names of the rest, sorted."""
    said: dict[str, list[str]] = {}
    for copy in copies:
        for key, value in copy.items():
            said.setdefault(key, []).append(value)
    found, doubtful = {}, []
    for key, values in said.items():
        often = max(values, key=values.count)
        if values.count(often) > 1:
            found[key] = often
        else:
            doubtful.append(key)
    return found, sorted(doubtful)


def run_of_records(records: Mapping[str, Mapping[str, str]]) -> list[Run]:
    """The copies in the metadata records of a file, by name of the record."""
    copies = [texts(records[layout.RUN_RECORD])] if layout.RUN_RECORD in records else []
    text = records.get(layout.ROSBAG2_RECORD, {}).get("serialized_metadata")
    repeated = None if text is None else run_of_description(text)
    return copies if repeated is None else [*copies, repeated]
