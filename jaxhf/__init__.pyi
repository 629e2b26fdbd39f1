from . import mujoco as mujoco
from .core.errors import ArgumentError as ArgumentError
from .core.settings import Settings as Settings
from .core.version import __version__ as __version__
from .fitting.fit import fit as fit
from .fitting.given import (
    Checkpoint as Checkpoint,
    Draws as Draws,
    Noise as Noise,
    Prior as Prior,
    Step as Step,
    Stop as Stop,
    Unknown as Unknown,
)
from .fitting.trust.judge import Fit as Fit
from .fitting.trust.words import Region as Region
from .fitting.windows import Fitted as Fitted, Mosaic as Mosaic, fit_windows as fit_windows
from .io.errors import SceneError as SceneError
from .io.pictures.images import load_image as load_image, save_image as save_image
from .io.scenes.load import load_scene as load_scene
from .io.terrain.load import jacksboro as jacksboro, load_heights as load_heights
from .io.terrain.meshes import save_mesh as save_mesh
from .io.terrain.save import save_heights as save_heights
from .io.terrain.terrain import Terrain as Terrain
from .maps.curvature import curvature as curvature
from .maps.hillshade import hillshade as hillshade
from .maps.insolation import insolation as insolation
from .maps.relief import color_relief as color_relief, relief as relief
from .maps.ruggedness import ruggedness as ruggedness
from .maps.skyview import horizon as horizon, sky_view as sky_view
from .maps.slope import aspect as aspect, slope as slope
from .maps.viewshed import LineOfSight as LineOfSight, line_of_sight as line_of_sight, viewshed as viewshed
from .rendering.aovs import AOVS as AOVS
from .rendering.cast import cast as cast
from .rendering.render import (
    Prepared as Prepared,
    PreparedHeightfield as PreparedHeightfield,
    prepare as prepare,
    render as render,
)
from .scene.camera import Orthographic as Orthographic, Perspective as Perspective
from .scene.cylinder import Cylinder as Cylinder
from .scene.heightfield import Heightfield as Heightfield
from .scene.light import Directional as Directional, Point as Point, Sky as Sky, Sun as Sun
from .scene.material import (
    Hapke as Hapke,
    LommelSeeliger as LommelSeeliger,
    LunarLambert as LunarLambert,
    Material as Material,
    Matte as Matte,
    Minnaert as Minnaert,
    Mirror as Mirror,
    OrenNayar as OrenNayar,
)
from .scene.nested import nested as nested
from .scene.scene import Object as Object, Scene as Scene
from .scene.skirt import Skirt as Skirt
from .scene.sun import sun as sun
from .scene.texture import ImageTexture as ImageTexture
from .trace.hit import Hit as Hit, Status as Status
from .trace.normals import vertex_normals as vertex_normals
from .xla.compilation import compiler_options as compiler_options
