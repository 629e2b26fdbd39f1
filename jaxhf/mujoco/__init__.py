"""Rays, height scans, depth images and lidars on MuJoCo's geoms, in MuJoCo's own terms and without MuJoCo."""

from .geoms import Geoms as Geoms
from .hfield import HField as HField
from .ray import ray as ray
from .scan import grid_pattern as grid_pattern, height_scan as height_scan
from .sensors import depth_image as depth_image, lidar as lidar, lidar_pattern as lidar_pattern
from .surface import Scan as Scan
