"""Put a portrait of facerf into a Blender scene, lit by the map that facerf used.

    blender --python examples/blender/facerf_scene.py -- me.exr sky.exr 30

me.exr is an image of `facerf relight --background none --aov albedo,normal`; 30 is its --rotate. The portrait
stands in the plane x, z and looks along -y. World and plane agree with facerf: light from the image's right
comes from +x. Blender shows nothing of a file with several parts, so the image alone is written beside it, as
me_rgba.exr; a layer is had by `oiiotool me.exr --subimage albedo -o albedo.exr`.
"""

import math
import sys
from pathlib import Path
from typing import Any

# facerf's map has +z, toward the camera, in the middle; Blender's has +x there, and the camera is toward -y.
TURN_DEG = 90.0


def world_turn_deg(rotate_deg: float) -> float:
    """Rotation about z of the coordinates of Blender's environment texture, for a map of `--rotate`."""
    return TURN_DEG - rotate_deg


def add_world(bpy: Any, envmap: Path, rotate_deg: float) -> None:
    """Light the scene by a lat-long map as facerf does."""
    world = bpy.context.scene.world or bpy.data.worlds.new("facerf")
    bpy.context.scene.world = world
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    coordinates, mapping = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeMapping")
    picture, background = nodes.new("ShaderNodeTexEnvironment"), nodes.new("ShaderNodeBackground")
    output = nodes.new("ShaderNodeOutputWorld")
    mapping.vector_type = "POINT"
    mapping.inputs["Rotation"].default_value[2] = math.radians(world_turn_deg(rotate_deg))
    picture.image = bpy.data.images.load(str(envmap.resolve()))
    links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], picture.inputs["Vector"])
    links.new(picture.outputs["Color"], background.inputs["Color"])
    links.new(background.outputs["Background"], output.inputs["Surface"])


def image_alone(path: Path) -> Path:
    """The image of an EXR without its layers, in a file beside it; an image of one part is its own."""
    import OpenImageIO as oiio  # comes with Blender

    image = oiio.ImageBuf(str(path))
    if image.nsubimages == 1:
        return path
    alone = path.with_name(f"{path.stem}_rgba.exr")
    if not image.write(str(alone)):
        raise SystemExit(f"{alone}: {image.geterror()}")
    return alone


def add_portrait(bpy: Any, image_path: Path, height_m: float = 0.5) -> Any:
    """Add the relit person, cut out, as an upright plane that gives off its own light."""
    image = bpy.data.images.load(str(image_alone(image_path).resolve()))
    width_m = height_m * image.size[0] / max(1, image.size[1])
    bpy.ops.mesh.primitive_plane_add(size=1.0, rotation=(math.pi / 2, 0.0, 0.0))
    plane = bpy.context.object
    plane.name = "facerf portrait"
    plane.scale = (width_m, height_m, 1.0)
    material = bpy.data.materials.new("facerf portrait")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    texture, emission = nodes.new("ShaderNodeTexImage"), nodes.new("ShaderNodeEmission")
    clear, mix = nodes.new("ShaderNodeBsdfTransparent"), nodes.new("ShaderNodeMixShader")
    output = nodes.new("ShaderNodeOutputMaterial")
    texture.image, texture.extension = image, "CLIP"  # nothing of the other edge
    links.new(texture.outputs["Color"], emission.inputs["Color"])
    links.new(texture.outputs["Alpha"], mix.inputs[0])
    links.new(clear.outputs[0], mix.inputs[1])
    links.new(emission.outputs[0], mix.inputs[2])
    links.new(mix.outputs[0], output.inputs["Surface"])
    plane.data.materials.append(material)
    return plane


def main(arguments: list[str]) -> None:
    """Build the scene from the arguments after `--`."""
    import bpy

    image, envmap, rotate = arguments
    add_world(bpy, Path(envmap), float(rotate))
    add_portrait(bpy, Path(image))


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1 :])
