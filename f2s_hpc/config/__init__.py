"""Scenes: what is simulated. TOML with units in, a checked and immutable ``Scene`` in SI out."""

from f2s_hpc.config.catalogue import material_list, material_text
from f2s_hpc.config.describe import describe
from f2s_hpc.config.dump import dump_scene, scene_hash
from f2s_hpc.config.load import load_scene, parse_scene, scene_names, scene_text
from f2s_hpc.config.reference import key_reference
from f2s_hpc.config.schema import Scene

__all__ = ["Scene", "describe", "dump_scene", "key_reference", "load_scene", "material_list", "material_text",
           "parse_scene", "scene_hash", "scene_names", "scene_text"]
