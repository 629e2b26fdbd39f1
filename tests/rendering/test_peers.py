"""Pictures of a terrain that Mitsuba 3 made, at 1024 samples a pixel, with cast shadows."""

import importlib.util

import numpy as np
import pytest

import jaxhf


@pytest.mark.parametrize("light", ["std", "low"])
def test_pictures_by_mitsuba_agree(peers, light):
    """The RMSE as measured is 0.0015 to 0.0020, from the edges of the terrain and of shadows at 64 samples a pixel."""
    spec = importlib.util.spec_from_file_location("common_work", peers / "common_work.py")
    assert spec is not None
    assert spec.loader is not None
    work = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(work)
    targets = np.load(peers / f"targets_D_{light}.npz")
    eye, target, fov = work.CAMERAS["D"]
    camera = jaxhf.Perspective.look_at(eye, target, fov=fov, width=128, height=128)
    field = jaxhf.Object(jaxhf.Heightfield(work.terrain(64)), jaxhf.Matte(work.ALBEDO))
    settings = jaxhf.Settings(normals="six-angle", samples=64)
    for image, towards in zip(targets["images"], targets["lights"], strict=True):
        scene = jaxhf.Scene([field], camera, [jaxhf.Directional(towards)])
        ours = np.asarray(jaxhf.render(scene, settings))[..., 0]
        assert np.sqrt(np.mean((ours - image) ** 2)) < 0.0025
        assert image.std() > 0.05
