"""Which version of jaxhf is installed."""

import importlib.metadata

__version__ = importlib.metadata.version("jaxhf")
