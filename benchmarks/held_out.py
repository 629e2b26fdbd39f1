"""The cases that were not looked at while the default call of `jaxhf.fit` was built."""

from cases import Definition

HELD_OUT: dict[str, Definition] = {}
