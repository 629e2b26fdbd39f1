"""What rules say of values that break them, and that every number of a scene and of the settings has one."""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
from jaxhf.core.affine import invertible
from jaxhf.core.rules import OneOf, Whole, flag, require_fields
from jaxhf.core.types import ANGLE_OF_VIEW, COLOUR, FINITE, NUMBERS, POSITIVE, VECTOR, Number

DOOR = OneOf(Literal["open", "shut"])
SHARE = Number("lie in 0..1", lambda value: 0 <= value <= 1)
PIXELS = Whole(1, 8, "pixels")
# What keeps each rule, and what is said of values that break it.
RULES = {
    "whole": (Whole(0), [0, 2**40, np.int8(3)], {
        -1: "must be a whole number from 0 on, it is -1",
        2.0: "must be a whole number from 0 on, it is 2.0",
        True: "must be a whole number from 0 on, it is True",
        None: "must be a whole number from 0 on, it is None",
    }),
    "whole with a most": (PIXELS, [1, 8], {
        0: "must be a whole number of pixels from 1 on, it is 0",
        9: "must be at most 8, it is 9",
    }),
    "one of": (DOOR, ["open", "shut"], {
        "ajar": "must be one of open, shut; it is 'ajar'",
        None: "must be one of open, shut; it is None",
    }),
    "flag": (flag, [True, False], {1: "must be True or False, it is 1", None: "must be True or False, it is None"}),
    "finite": (FINITE, [0, -1e30, np.float32(2)], {
        np.nan: "must be finite, it is nan",
        -np.inf: "must be finite, it is -inf",
        2e30: "must be within -1e+30 and 1e+30, it is 2e+30",
        (1, 2): "must be one number, its shape is (2,)",
    }),
    "positive": (POSITIVE, [1e-300, np.array(7.0)], {
        0: "must be positive and finite, it is 0",
        np.inf: "must be positive and finite, it is inf",
        1e31: "must be within -1e+30 and 1e+30, it is 1e+31",
    }),
    "between": (ANGLE_OF_VIEW, [1e-9, 179.9], {
        0.0: "must lie between 0 and 180 degrees, it is 0.0",
        180: "must lie between 0 and 180 degrees, it is 180",
        np.nan: "must lie between 0 and 180 degrees, it is nan",
    }),
    "of its own": (SHARE, [0, 1], {1.5: "must lie in 0..1, it is 1.5"}),
    "of any shape": (NUMBERS, [3.0, ((1, 2), (3, 4))], {((1, np.nan),): "must be finite, it is [[1.0, nan]]"}),
    "vector": (VECTOR, [(1, 2, 3)], {
        (1, 2): "must hold three numbers, its shape is (2,)",
        (0, np.nan, 1): "must be finite, it is [0.0, nan, 1.0]",
    }),
    "colour": (COLOUR, [(0, 0, 0)], {1.0: "must be one number or three, its shape is ()"}),
}  # fmt: skip


def test_a_whole_number_that_is_traced_is_refused_as_such(as_users_call_it):
    with pytest.raises(jaxhf.ArgumentError, match="edge_samples must be known when programs are compiled, it is traced"):
        jax.jit(lambda n: jaxhf.Settings(edge_samples=n))(4)


@pytest.mark.parametrize("name", RULES)
def test_a_rule_says_what_is_wrong(name):
    rule, kept, broken = RULES[name]
    assert [rule(value) for value in kept] == [None] * len(kept)
    assert {value: rule(value) for value in broken} == broken


def test_numbers_of_jax_are_asked_for_their_shape_alone():
    """They may be traced, and those that are not need not have been computed yet."""
    assert [rule(jnp.array(jnp.nan)) for rule in (FINITE, POSITIVE, SHARE, NUMBERS)] == [None] * 4
    assert invertible(jnp.zeros((4, 4))) is None
    said = []
    jax.jit(lambda x: said.extend((POSITIVE(x), VECTOR(x), invertible(x))))(1.0)
    assert said == [None, "must hold three numbers, its shape is ()", "must be a 4x4 matrix, its shape is ()"]


@dataclasses.dataclass
class Door:
    state: str | None = dataclasses.field(default="open", metadata={"rule": DOOR})
    width: int | None = dataclasses.field(default=None, metadata={"rule": PIXELS})
    inner: object = dataclasses.field(default=1.0, metadata={"rule": FINITE})
    note: str = "no rule"


def test_fields_keep_their_rules():
    """None where it is the default, and a dataclass, which has rules of its own, are not asked."""
    require_fields(Door(inner=Door(state="ajar")))
    for door, name, said in ((Door(state=None), "state", "must be one of"), (Door(width=9), "width", "must be at most 8")):
        with pytest.raises(jaxhf.ArgumentError, match=f"^Door: {name} {said}") as error:
            require_fields(door)
        assert error.value.argument == name


RECORDS = (
    jaxhf.Settings, jaxhf.Perspective, jaxhf.Orthographic, jaxhf.Directional, jaxhf.Sun, jaxhf.Point, jaxhf.Sky, jaxhf.Matte,
    jaxhf.Mirror, jaxhf.Cylinder, jaxhf.Object, jaxhf.Scene,
)  # fmt: skip
PARTS = {"shape", "material", "objects", "camera", "lights"}  # checked by their kinds


@pytest.mark.parametrize("record", RECORDS)
def test_every_field_has_a_rule(record):
    named = {field.name for field in dataclasses.fields(record) if not field.name.startswith("_")}
    ruled = {field.name for field in dataclasses.fields(record) if "rule" in field.metadata}
    assert named - ruled <= PARTS
    assert ruled
