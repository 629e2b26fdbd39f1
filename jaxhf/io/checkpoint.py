"""Checkpoints of a fit: one file, written whole or not at all, with a checksum."""

import hashlib
import io
import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .errors import FileError
from .files import PathLike, replacing, require_file

_MAGIC = b"jaxhf checkpoint 2\n"


def digest(choices: Any, values: Any) -> str:
    """A hash of what `repr` tells of choices, and of the bits of a pytree's leaves."""
    found = hashlib.sha256(repr(choices).encode())
    for leaf in map(np.asarray, jax.tree.leaves(values)):
        found.update(repr((leaf.shape, leaf.dtype.str)).encode() + leaf.tobytes())
    return found.hexdigest()


def save_checkpoint(path: PathLike, facts: dict[str, Any], arrays: Any) -> None:
    """Writes a checkpoint: facts (what JSON can hold) and a pytree's arrays; see `replacing`."""
    stream = io.BytesIO()
    stream.write(json.dumps(facts).encode() + b"\n")
    eqx.tree_serialise_leaves(stream, arrays)
    body = stream.getvalue()
    with replacing(Path(path)) as temporary:
        temporary.write_bytes(_MAGIC + hashlib.sha256(body).hexdigest().encode() + b"\n" + body)


def load_facts(path: PathLike) -> dict[str, Any]:
    """The facts of a checkpoint; FileError where the file is damaged or is something else."""
    return json.loads(_body(path).partition(b"\n")[0])


def load_facts_of(path: PathLike, fingerprint: str) -> dict[str, Any]:
    """Those besides its fingerprint; FileError where that is another one."""
    facts = load_facts(path)
    if facts.pop("fingerprint", None) != fingerprint:
        raise FileError(f"{path}: this is the checkpoint of another fit: its pictures, scenes or options differ")
    return facts


def load_arrays(path: PathLike, like: Any) -> Any:
    """The arrays of a checkpoint, in a pytree of the same structure, shapes and dtypes as `like`."""
    return eqx.tree_deserialise_leaves(io.BytesIO(_body(path).partition(b"\n")[2]), like)


def _body(path: PathLike) -> bytes:
    content = require_file(path).read_bytes()
    if not content.startswith(_MAGIC):
        raise FileError(f"{path}: this is not a checkpoint of jaxhf's, or not of this version")
    checksum, _, body = content[len(_MAGIC) :].partition(b"\n")
    if hashlib.sha256(body).hexdigest().encode() != checksum:
        raise FileError(f"{path}: the checkpoint is damaged: its checksum does not agree")
    return body
