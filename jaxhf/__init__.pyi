from ._camera import Orthographic as Orthographic, Perspective as Perspective
from ._cylinder import Cylinder as Cylinder
from ._descent import Step as Step, Stop as Stop
from ._fit import Fit as Fit, fit as fit
from ._heightfield import Heightfield as Heightfield, vertex_normals as vertex_normals
from ._hit import Hit as Hit
from ._light import Directional as Directional, Point as Point, Sky as Sky
from ._material import Matte as Matte, Mirror as Mirror
from ._render import AOVS as AOVS, Prepared as Prepared, cast as cast, prepare as prepare, render as render
from ._scene import Object as Object, Scene as Scene
from ._settings import Settings as Settings
from ._texture import ImageTexture as ImageTexture
from ._walk import Status as Status
from .io import (
    SceneError as SceneError,
    Terrain as Terrain,
    jacksboro as jacksboro,
    load_heights as load_heights,
    load_image as load_image,
    load_scene as load_scene,
    save_heights as save_heights,
    save_image as save_image,
)
