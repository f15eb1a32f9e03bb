"""Facts of a run in a bag, where several copies have to agree.

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
    """Facts of the run in metadata.yaml, or its copy in the file; None where it cannot be
    read."""
    try:
        description = load_yaml(text)
        description = description.get("rosbag2_bagfile_information", description)
        return texts(description["custom_data"] or {})
    except (YamlError, KeyError, AttributeError, TypeError):  # not the shape of a description
        return None


def agreed(copies: Sequence[Run]) -> tuple[Run, list[str]]:
    """Facts with equal values in at least two copies, and the names of the others, sorted."""
    values_by_key: dict[str, list[str]] = {}
    for copy in copies:
        for key, value in copy.items():
            values_by_key.setdefault(key, []).append(value)
    facts, doubtful = {}, []
    for key, values in values_by_key.items():
        often = max(values, key=values.count)
        if values.count(often) > 1:
            facts[key] = often
        else:
            doubtful.append(key)
    return facts, sorted(doubtful)


def run_of_records(records: Mapping[str, Mapping[str, str]]) -> list[Run]:
    """The copies in the metadata records of a file, by name of the record."""
    copies = [texts(records[layout.RUN_RECORD])] if layout.RUN_RECORD in records else []
    text = records.get(layout.ROSBAG2_RECORD, {}).get("serialized_metadata")
    repeated = None if text is None else run_of_description(text)
    return copies if repeated is None else [*copies, repeated]
