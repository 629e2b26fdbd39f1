"""Names that options of maps may have; apart, as `jaxhf --help` lists them and does without NumPy."""

ALGORITHMS = ("horn", "zevenbergen-thorne")
VARIANTS = ("regular", "combined", "multidirectional", "igor")
ENTRIES = ("interpolate", "nearest", "exact")
WEIGHTINGS = ("solid-angle", "horizontal", "slope")
WANTED = ("visible", "above-ground")
RUGGEDNESS = ("roughness", "tri", "tri-wilson", "tpi")
CURVATURES = ("profile", "tangential", "plan", "mean", "gaussian")
QUADRATICS = ("evans", "zevenbergen-thorne")
SUNLIGHT = ("energy", "direct", "diffuse", "hours")
