"""jaxhf renders heightfields in JAX, and differentiates the picture with respect to the heights.

The public names are those of `__init__.pyi`. Each is imported when it is first used, so that `python -m jaxhf --help`
does not wait for JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
