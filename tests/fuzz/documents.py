"""Files as documents: what they hold, for `values` to change, and the bytes of a document."""

import gzip
import io
import json
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fuzz import inputs, values

_ATTEMPTS = 30


class Form(NamedTuple):
    """How to read and write documents of a kind of file."""

    read: Callable[[bytes], Any]
    write: Callable[[Any], bytes]


def changed(
    rng: np.random.Generator, name: str, content: bytes, count: int
) -> tuple[bytes, list[str]]:
    """Return the file `name` with `count` values changed, and what was changed.
    A change that the format cannot hold, as a text where a message of ROS has a number, is drawn again.
    """
    form, said = (
        next(form for suffix, form in FORMS.items() if name.endswith(suffix)),
        list[str](),
    )
    document = form.read(content)
    before = form.write(document)
    for _ in range(_ATTEMPTS * count):
        if len(said) == count:
            break
        try:
            what = values.change(rng, document)
            content = form.write(document)
        except Exception:  # of the libraries that write the format
            document = form.read(before)
        else:
            said.append(f"{name}{what}")
            before = content
    return content, said


def _read_lines(content: bytes) -> Any:
    return [json.loads(line) for line in content.decode().splitlines() if line.strip()]


def _write_lines(document: Any) -> bytes:
    return "".join(f"{json.dumps(each)}\n" for each in document).encode()


def _read_yaml(content: bytes) -> Any:
    from ruamel.yaml import YAML  # slow

    return YAML(typ="safe").load(content)


def _write_yaml(document: Any) -> bytes:
    from ruamel.yaml import YAML  # slow

    text = io.StringIO()
    YAML(typ="safe", pure=True).dump(document, text)
    return text.getvalue().encode("utf-8", "surrogatepass")


_MARKS = ";", "\t", ","


def _read_cells(content: bytes) -> Any:
    """Rows of cells, numbers and JSON as values; the first entry is what separates the cells."""
    lines = content.decode().splitlines()
    mark = next((mark for mark in _MARKS if mark in (lines or [""])[0]), " ")
    return {
        "mark": mark,
        "rows": [[_cell(text) for text in line.split(mark)] for line in lines],
    }


def _cell(text: str) -> Any:
    with suppress(ValueError):
        return json.loads(text)
    return text


def _write_cells(document: Any) -> bytes:
    mark, rows = document["mark"], document["rows"]
    return "\n".join(
        mark.join(map(_text, row if isinstance(row, list) else [row])) for row in rows
    ).encode("utf-8", "surrogatepass")


def _text(value: Any) -> str:
    return (
        "" if value is None else value if isinstance(value, str) else json.dumps(value)
    )


def _read_bag2(storage: str) -> Callable[[bytes], Any]:
    """Messages of ROS as dictionaries, with their topics and times."""

    def read(content: bytes) -> Any:
        from rosbags.rosbag2 import Reader

        store = _store(ros1=False)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "bag"
            inputs.write_bag(path, inputs.drive(), storage)
            (file,) = (file for file in path.iterdir() if file.suffix != ".yaml")
            file.write_bytes(content)
            with Reader(path) as reader:
                return [
                    {
                        "topic": connection.topic,
                        "log_ns": log_ns,
                        "message": _tree(
                            store.deserialize_cdr(data, connection.msgtype)
                        ),
                    }
                    for connection, log_ns, data in reader.messages()
                ]

    return read


def _write_bag2(storage: str) -> Callable[[Any], bytes]:
    def write(document: Any) -> bytes:
        from rosbags.rosbag2 import StoragePlugin, Writer

        store = _store(ros1=False)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "bag"
            with Writer(
                path,
                version=Writer.VERSION_LATEST,
                storage_plugin=StoragePlugin[storage.upper()],
            ) as bag:
                topics: dict[str, Any] = {}
                for each in document:
                    message = _message(store, each["message"])
                    if each["topic"] not in topics:
                        topics[each["topic"]] = bag.add_connection(
                            each["topic"], message.__msgtype__, typestore=store
                        )
                    data = store.serialize_cdr(message, message.__msgtype__)
                    bag.write(topics[each["topic"]], each["log_ns"], data)
            (file,) = (file for file in path.iterdir() if file.suffix != ".yaml")
            return file.read_bytes()

    return write


def _read_bag1(content: bytes) -> Any:
    from rosbags.rosbag1 import Reader

    store = _store(ros1=True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.bag"
        path.write_bytes(content)
        with Reader(path) as reader:
            return [
                {
                    "topic": connection.topic,
                    "log_ns": log_ns,
                    "message": _tree(store.deserialize_ros1(data, connection.msgtype)),
                }
                for connection, log_ns, data in reader.messages()
            ]


def _write_bag1(document: Any) -> bytes:
    from rosbags.rosbag1 import Writer

    store = _store(ros1=True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.bag"
        with Writer(path) as bag:
            topics: dict[str, Any] = {}
            for each in document:
                message = _message(store, each["message"])
                if each["topic"] not in topics:
                    topics[each["topic"]] = bag.add_connection(
                        each["topic"], message.__msgtype__, typestore=store
                    )
                data = store.serialize_ros1(message, message.__msgtype__)
                bag.write(topics[each["topic"]], each["log_ns"], data)
        return path.read_bytes()


def _store(ros1: bool) -> Any:
    if ros1:
        from rosbags.typesys import Stores, get_typestore

        return get_typestore(Stores.ROS1_NOETIC)
    from fgtrack.inputs.ros.messages import MessageFactory

    return MessageFactory().typestore


_TYPE = "__msgtype__"


def _tree(value: Any) -> Any:
    if is_dataclass(value):
        own = {
            each.name: _tree(getattr(value, each.name))
            for each in fields(value)
            if each.name != _TYPE
        }
        return {_TYPE: value.__msgtype__, **own}  # type: ignore[attr-defined]  # of all messages of ROS
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [_tree(each) for each in value] if isinstance(value, list) else value


def _message(store: Any, tree: Any) -> Any:
    if isinstance(tree, dict) and _TYPE in tree:
        given = {
            key: _message(store, value) for key, value in tree.items() if key != _TYPE
        }
        return store.types[tree[_TYPE]](**given)
    if isinstance(tree, list):
        items = [_message(store, each) for each in tree]
        return (
            np.array(items, dtype=np.float64)
            if all(isinstance(each, float | int) for each in items)
            else items
        )
    return tree


def _made_of(records: Callable[[], Any], write: Callable[[Any], bytes]) -> Form:
    """The form of a file that is always made of the same `records`."""
    return Form(lambda _: records(), write)


_LINES = Form(_read_lines, _write_lines)
_CELLS = Form(_read_cells, _write_cells)
#: By the end of the name of a file.
FORMS: dict[str, Form] = {
    ".jsonl": _LINES,
    ".gz": Form(
        lambda content: _read_lines(gzip.decompress(content)),
        lambda doc: gzip.compress(_write_lines(doc)),
    ),
    ".json": Form(json.loads, lambda document: json.dumps(document).encode()),
    ".yaml": Form(_read_yaml, _write_yaml),
    ".csv": _CELLS,
    ".tsv": _CELLS,
    ".txt": _CELLS,
    ".mcap": Form(_read_bag2("mcap"), _write_bag2("mcap")),
    ".db3": Form(_read_bag2("sqlite3"), _write_bag2("sqlite3")),
    ".bag": Form(_read_bag1, _write_bag1),
    ".ast": _made_of(inputs.aircraft, inputs.asterix),
    ".log": _made_of(inputs.ships, inputs.nmea),
}
