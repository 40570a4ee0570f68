"""Our values as Blender's: meshes, materials, lights and cameras built through `bpy`.

Blender's camera has OpenGL's axes (x right, y up, z backwards), its images start at the bottom row, its v runs up;
everything else is as in `scene.conventions`. Matrices are handed over as columns, as `bpy` takes nested lists.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from mv3d_cli.capture.lighting import COSINE_OVER_PI, harmonics
from mv3d_cli.capture.rendering import sun_camera
from mv3d_cli.kernels.shade import Light
from mv3d_cli.scene.camera import Camera, Orthographic
from mv3d_cli.scene.conventions import OPENCV_FROM_OPENGL
from mv3d_cli.scene.mesh import Material, Mesh, Texture

SKY_ROWS = 64
"""Rows of the environment's picture; an environment of degree 2 has no finer detail."""
SENSOR = 36.0

_EXTENSION = {"repeat": "REPEAT", "clamp": "EXTEND", "mirror": "MIRROR"}


def add_mesh(bpy: Any, mesh: Mesh, light: Light | None) -> None:
    """The mesh as an object of the scene; without a light its surface glows with its albedo."""
    a, b, c = mesh.faces.T
    proper = (a != b) & (b != c) & (c != a)
    faces, face_material = mesh.faces[proper], mesh.face_material[proper]
    data = bpy.data.meshes.new("mesh")
    _add_triangles(data, mesh.vertices, faces)
    images: dict[int, Any] = {}
    for material in mesh.materials:
        data.materials.append(_material(bpy, mesh, material, light, images))
    data.polygons.foreach_set("material_index", np.ascontiguousarray(face_material, np.int32))
    if mesh.uvs is not None:
        uvs = mesh.uvs[faces.ravel()] * np.array([1, -1], np.float32) + np.array([0, 1], np.float32)
        data.uv_layers.new(name="uv").data.foreach_set("uv", uvs.ravel())
    if mesh.colors is not None:
        colors = data.color_attributes.new("paint", "FLOAT_COLOR", "POINT")
        colors.data.foreach_set("color", mesh.colors.ravel())
    data.update(calc_edges=True)
    if mesh.normals is not None:
        data.shade_smooth()
        data.normals_split_custom_set_from_vertices(mesh.normals)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("mesh", data))


def _add_triangles(data: Any, vertices: Float32[np.ndarray, "v 3"], faces: np.ndarray) -> None:
    """Vertices and flat triangles into an empty Blender mesh."""
    data.vertices.add(len(vertices))
    data.vertices.foreach_set("co", np.ascontiguousarray(vertices).ravel())
    data.loops.add(3 * len(faces))
    data.loops.foreach_set("vertex_index", np.ascontiguousarray(faces, np.int32).ravel())
    data.polygons.add(len(faces))
    data.polygons.foreach_set("loop_start", np.arange(0, 3 * len(faces), 3, dtype=np.int32))
    data.shade_flat()


def _material(bpy: Any, mesh: Mesh, material: Material, light: Light | None, images: dict[int, Any]) -> Any:
    """Albedo into a diffuse, glossy or glowing surface, cut out where the alpha test fails."""
    result = bpy.data.materials.new(material.name or "material")
    result.use_nodes = True
    nodes, links = result.node_tree.nodes, result.node_tree.links
    nodes.clear()
    picture = None
    if material.texture is not None and mesh.uvs is not None:
        picture = _picture(bpy, nodes, links, material.texture, images)
    shader = _surface(nodes, material, light)
    links.new(_albedo(nodes, links, mesh, material, picture), shader.inputs[0])
    surface = shader.outputs[0]
    cutoff = _cutoff(material)
    if picture is not None and cutoff > 0:
        test = _math(nodes, links, "LESS_THAN", picture.outputs["Alpha"], cutoff)
        mix = nodes.new("ShaderNodeMixShader")
        links.new(test, mix.inputs[0])
        links.new(surface, mix.inputs[1])
        links.new(nodes.new("ShaderNodeBsdfTransparent").outputs[0], mix.inputs[2])
        surface = mix.outputs[0]
    links.new(surface, nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    return result


def _surface(nodes: Any, material: Material, light: Light | None) -> Any:
    """The shader node that takes the albedo as its first input."""
    if light is None:
        return nodes.new("ShaderNodeEmission")
    if light.specular == 0 or material.roughness >= 1:
        return nodes.new("ShaderNodeBsdfDiffuse")
    shader = nodes.new("ShaderNodeBsdfPrincipled")
    shader.inputs["Roughness"].default_value = material.roughness
    shader.inputs["Specular IOR Level"].default_value = 0.5 * light.specular
    return shader


def _cutoff(material: Material) -> float:
    """The least alpha of the texture that is kept (as `kernels.shade` has it); 0 = no test."""
    match material.alpha_mode:
        case "mask":
            return material.alpha_cutoff / max(material.base_color[3], 1e-3)
        case "blend":
            return 0.5
        case _:
            return 0.0


def _albedo(nodes: Any, links: Any, mesh: Mesh, material: Material, picture: Any | None) -> Any:
    """Socket of base colour * vertex colour * texture, linear."""
    factor = nodes.new("ShaderNodeRGB")
    factor.outputs[0].default_value = (*material.base_color[:3], 1.0)
    color = factor.outputs[0]
    if mesh.colors is not None:
        vertex_color = nodes.new("ShaderNodeVertexColor")
        vertex_color.layer_name = "paint"
        color = _product(nodes, links, color, vertex_color.outputs["Color"])
    if picture is not None:
        color = _product(nodes, links, color, picture.outputs["Color"])
    return color


def _product(nodes: Any, links: Any, a: Any, b: Any) -> Any:
    node = nodes.new("ShaderNodeVectorMath")
    node.operation = "MULTIPLY"
    links.new(a, node.inputs[0])
    links.new(b, node.inputs[1])
    return node.outputs[0]


def _math(nodes: Any, links: Any, operation: str, socket: Any, value: float) -> Any:
    node = nodes.new("ShaderNodeMath")
    node.operation = operation
    links.new(socket, node.inputs[0])
    node.inputs[1].default_value = value
    return node.outputs[0]


def _picture(bpy: Any, nodes: Any, links: Any, texture: Texture, images: dict[int, Any]) -> Any:
    """The image node of a texture, its uv wrapped as the texture says."""
    node = nodes.new("ShaderNodeTexImage")
    key = id(texture)
    if key not in images:
        images[key] = _image(bpy, texture)
    node.image = images[key]
    node.interpolation = "Linear"
    uv = nodes.new("ShaderNodeUVMap")
    uv.uv_map = "uv"
    place = uv.outputs[0]
    if texture.wrap_u == texture.wrap_v:
        node.extension = _EXTENSION[texture.wrap_u]
    else:  # an image node wraps both axes alike
        node.extension = "EXTEND"
        place = _wrapped(nodes, links, place, texture)
    links.new(place, node.inputs["Vector"])
    return node


def _wrapped(nodes: Any, links: Any, place: Any, texture: Texture) -> Any:
    """uv with each axis brought into [0, 1] on its own."""
    split, join = nodes.new("ShaderNodeSeparateXYZ"), nodes.new("ShaderNodeCombineXYZ")
    links.new(place, split.inputs[0])
    operations = {"repeat": "WRAP", "mirror": "PINGPONG"}
    for axis, wrap in enumerate((texture.wrap_u, texture.wrap_v)):
        socket = split.outputs[axis]
        if wrap in operations:
            socket = _math(nodes, links, operations[wrap], socket, 1.0)
            socket.node.inputs[2].default_value = 0.0
        links.new(socket, join.inputs[axis])
    return join.outputs[0]


def _image(bpy: Any, texture: Texture) -> Any:
    """The texture's pixels as a Blender image; alpha stays apart from colour, as in our sampling."""
    height, width = texture.pixels.shape[:2]
    image = bpy.data.images.new("texture", width, height, alpha=True)
    image.colorspace_settings.name = "sRGB"
    image.alpha_mode = "CHANNEL_PACKED"
    image.pixels.foreach_set((texture.pixels[::-1].astype(np.float32) / 255).ravel())
    image.pack()
    return image


def sky_of(ambient: Float[np.ndarray, "9 3"]) -> Float32[np.ndarray, "rows columns 3"]:
    """Equirectangular radiance, bottom row first, whose irradiance / pi has the coefficients `ambient`.

    Radiance = coefficients over the cosine lobe's (Ramamoorthi & Hanrahan, 2001, eq. 8), nowhere below zero; what
    the clamping adds to the coefficients is taken off again by fixed-point steps.
    """
    elevation = ((np.arange(SKY_ROWS) + 0.5) / SKY_ROWS - 0.5) * np.pi
    azimuth = (0.5 - (np.arange(2 * SKY_ROWS) + 0.5) / (2 * SKY_ROWS)) * 2 * np.pi
    z, turn = np.meshgrid(elevation, azimuth, indexing="ij")
    directions = np.stack([np.cos(z) * np.cos(turn), np.cos(z) * np.sin(turn), np.sin(z)], -1).reshape(-1, 3)
    basis = harmonics(directions)
    weights = np.cos(z).reshape(-1, 1) * (np.pi / SKY_ROWS) ** 2
    wanted = ambient / COSINE_OVER_PI[:, None]
    guess = wanted
    for _ in range(30):
        guess = guess + wanted - basis.T @ (weights * np.maximum(basis @ guess, 0))
    radiance = np.maximum(basis @ guess, 0)
    return radiance.reshape(SKY_ROWS, 2 * SKY_ROWS, 3).astype(np.float32)


def add_light(bpy: Any, light: Light) -> None:
    """The environment, and a sun whose disc blurs a shadow by `softness` at a distance of one scene unit.

    A Blender sun of strength s adds albedo * s / pi * cosine, ours albedo * sun_color * cosine.
    """
    sky = sky_of(light.ambient)
    image = bpy.data.images.new("sky", sky.shape[1], sky.shape[0], float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    image.pixels.foreach_set(np.concatenate([sky, np.ones_like(sky[..., :1])], axis=-1).ravel())
    image.pack()
    world = bpy.data.worlds.new("world")
    bpy.context.scene.world = world
    world.use_nodes = True
    node = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    node.image = image
    world.node_tree.links.new(node.outputs["Color"], world.node_tree.nodes["Background"].inputs["Color"])
    strength = float(np.max(light.sun_color))
    if strength <= 0:
        return
    sun = bpy.data.lights.new("sun", "SUN")
    sun.color = (light.sun_color / strength).tolist()
    sun.energy = np.pi * strength
    sun.angle = 2 * np.arctan(light.softness)
    place = bpy.data.objects.new("sun", sun)
    place.matrix_world = _columns(sun_camera(light.sun_direction))
    bpy.context.scene.collection.objects.link(place)


def add_eye(bpy: Any) -> Any:
    """The scene's camera, to be placed by `aim`."""
    eye = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    bpy.context.scene.collection.objects.link(eye)
    bpy.context.scene.camera = eye
    return eye


def aim(scene: Any, eye: Any, camera: Camera) -> None:
    """Places the scene's camera; of square pictures only."""
    eye.matrix_world = _columns(camera)
    lens, aspect = eye.data, scene.render
    lens.clip_start, lens.clip_end = 1e-3, 1e3
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", SENSOR
    aspect.pixel_aspect_x = aspect.pixel_aspect_y = 1.0
    match camera.projection:
        case Orthographic(half_extent):
            lens.type, lens.ortho_scale = "ORTHO", 2 * half_extent
            lens.shift_x = lens.shift_y = 0.0
        case projection:
            (fx, fy), (cx, cy) = projection.focal, projection.centre
            lens.type, lens.lens = "PERSP", fx * SENSOR
            aspect.pixel_aspect_x, aspect.pixel_aspect_y = max(fy / fx, 1.0), max(fx / fy, 1.0)
            lens.shift_x, lens.shift_y = 0.5 - cx, (cy - 0.5) * fx / fy


def _columns(camera: Camera) -> list[list[float]]:
    return (camera.world_from_camera @ OPENCV_FROM_OPENGL).T.tolist()
