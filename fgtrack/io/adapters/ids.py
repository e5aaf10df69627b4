"""Numbers for the ids of objects that a source gives as a text."""

from hashlib import blake2b

_INT64 = range(-(1 << 63), 1 << 63)
_BYTES = 6  # below 2^53, so that a table of floats holds it; a thousand names clash once in 5e8 data sets


def object_id(value: object) -> int | None:
    """`value` as an id: an integer, or its text, as it is; of any other text a number that is always the same.

    None for an empty text. A name has the same number wherever it stands: in detections, in the truth, in another file.
    """
    text = str(value).strip()
    if not text:
        return None
    if text.removeprefix("-").isdecimal() and text.isascii() and len(text) < 20 and int(text) in _INT64:
        return int(text)
    return int.from_bytes(blake2b(text.encode(errors="replace"), digest_size=_BYTES).digest(), "big")
