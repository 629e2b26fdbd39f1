"""What rules say of values that break them, and that every setting has one."""

import dataclasses
from typing import Literal

import numpy as np
import pytest

import jaxhf
from jaxhf.core.rules import OneOf, Whole, flag, require_fields

DOOR = OneOf(Literal["open", "shut"])
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
}  # fmt: skip


@pytest.mark.parametrize("name", RULES)
def test_a_rule_says_what_is_wrong(name):
    rule, kept, broken = RULES[name]
    assert [rule(value) for value in kept] == [None] * len(kept)
    assert {value: rule(value) for value in broken} == broken


@dataclasses.dataclass
class Door:
    state: str | None = dataclasses.field(default="open", metadata={"rule": DOOR})
    width: int | None = dataclasses.field(default=None, metadata={"rule": PIXELS})
    inner: object = dataclasses.field(default=1.0, metadata={"rule": DOOR})
    note: str = "no rule"


def test_fields_keep_their_rules():
    """None where it is the default, and a dataclass, which has rules of its own, are not asked."""
    require_fields(Door(inner=Door(state="ajar")))
    for door, name, said in ((Door(state=None), "state", "must be one of"), (Door(width=9), "width", "must be at most 8")):
        with pytest.raises(jaxhf.ArgumentError, match=f"^Door: {name} {said}") as error:
            require_fields(door)
        assert error.value.argument == name


def test_every_setting_has_a_rule():
    assert all("rule" in field.metadata for field in dataclasses.fields(jaxhf.Settings))
