"""Files of the compiled code of one function."""

import json
import pickle
import sys
from collections.abc import Mapping
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any
from uuid import uuid4

import llvmlite
import numba


class CodeStore:
    """Files of the compiled code of one function: an index, `.nbi`, and the code of each signature, `.nbc`.

    The index is JSON and has the SHA-256 of each code file. So a damaged file is recognised before the file is
    unpickled or run. A code file is named after its content, so that processes that write at the same time do not mix
    their files. The code is valid for one `stamp`, a digest of the sources, and for one version of numba and Python.
    """

    def __init__(self, folder: str, name: str, stamp: bytes) -> None:
        self._folder, self._name = Path(folder), name
        self._index_path = self._folder / f"{name}.nbi"
        versions = numba.__version__, llvmlite.__version__, sys.version
        self._stamp = sha256(stamp + repr(versions).encode()).hexdigest()

    def load(self, key: object) -> Any:
        """Return the data saved under `key`, or None. Raises `OSError` or `ValueError` for damaged files."""
        stamp, digests = self._read()
        digest = digests.get(_key_text(key))
        if digest is None or stamp != self._stamp:
            return None
        try:
            code = self._code_path(digest).read_bytes()
        except FileNotFoundError:
            return None
        if sha256(code).hexdigest() != digest:
            raise ValueError(f"{self._code_path(digest)}: is damaged")
        return pickle.loads(code)

    def save(self, key: object, data: object) -> None:
        """Store `data` under `key`; damaged files are replaced, code of other sources is deleted. Raises `OSError`."""
        code = pickle.dumps(data)
        try:
            stamp, stored = self._read()
        except (OSError, ValueError):
            stamp, stored = "", {}
        kept = stored if stamp == self._stamp else {}
        digests = {**kept, _key_text(key): sha256(code).hexdigest()}
        _replace(self._code_path(digests[_key_text(key)]), code)
        self._write(digests)
        for unused in set(stored.values()) - set(digests.values()):
            self._code_path(unused).unlink(missing_ok=True)

    def flush(self) -> None:
        """Empty the index, so that no stored code is used any more. Raises `OSError`."""
        self._write({})

    def _code_path(self, digest: str) -> Path:
        return self._folder / f"{self._name}.{digest[:16]}.nbc"

    def _read(self) -> tuple[str, dict[str, str]]:
        """Return the stamp of the index and the digests of codes by key. Raises `OSError` or `ValueError`."""
        try:
            index = json.loads(self._index_path.read_bytes())
        except FileNotFoundError:
            return "", {}
        except RecursionError as error:
            raise ValueError(f"{self._index_path}: is damaged") from error
        if not isinstance(index, dict) or not isinstance(
            digests := index.get("digests"), dict
        ):
            raise ValueError(f"{self._index_path}: is damaged")
        if not all(
            isinstance(digest, str) and digest.isalnum() for digest in digests.values()
        ):
            raise ValueError(f"{self._index_path}: is damaged")
        return str(index.get("stamp")), digests

    def _write(self, digests: Mapping[str, str]) -> None:
        index = {"stamp": self._stamp, "digests": digests}
        _replace(self._index_path, json.dumps(index).encode())


def _key_text(key: object) -> str:
    """Return a digest of `key`, which consists of a signature and a processor, as text."""
    return sha256(repr(key).encode()).hexdigest()[:16]


def _replace(path: Path, content: bytes) -> None:
    """Write a file under a temporary name, then rename it to `path`. Raises `OSError`."""
    part = path.with_name(f"{path.name}.{uuid4().hex[:16]}.part")
    try:
        part.write_bytes(content)
        part.replace(path)
    except OSError:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise
