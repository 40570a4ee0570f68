"""Shading against textures, integrals and shadows that can be computed by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import dblquad

from mv3d_cli.capture.lighting import ambient_from_lamps, harmonics, random_light, studio
from mv3d_cli.capture.rendering import render
from mv3d_cli.kernels.shade import Light, mip_levels
from mv3d_cli.scene.camera import Camera, Orthographic, direction_on_sphere, look_at_origin
from mv3d_cli.scene.conventions import linear_from_srgb, normal_from_bytes, srgb_from_linear
from mv3d_cli.scene.mesh import Material, Mesh, Texture, Wrap

FRONT = look_at_origin("front", (0.0, -2.0, 0.0), Orthographic())


def quad(material: Material, repeat: float = 1.0, tilt: float = 0.0) -> Mesh:
    """A square over the whole picture, facing the front camera, uv from (0, 0) at its upper left."""
    corners = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], np.float32)
    corners[:, 1] = tilt * corners[:, 2]
    uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32) * repeat
    faces = np.array([[0, 2, 1], [0, 3, 2]], np.int32)
    return Mesh(corners, faces, np.zeros(2, np.int32), (material,), uvs=uvs)


def noise_texture(size: int, wrap: Wrap = "repeat", alpha: int = 255) -> Texture:
    pixels = np.random.default_rng(0).integers(0, 256, (size, size, 4), np.uint8)
    pixels[..., 3] = alpha
    return Texture(pixels, wrap, wrap)


def test_textured_quad_shows_its_texture() -> None:
    texture = noise_texture(64)
    color = render(quad(Material(texture=texture)), [FRONT], 64, None).frames[0].color
    assert color is not None
    assert np.abs(color.astype(int) - texture.pixels).max() <= 1


def test_minified_texture_is_averaged_in_linear_light() -> None:
    texture = noise_texture(64)
    color = render(quad(Material(texture=texture)), [FRONT], 16, None).frames[0].color
    linear = linear_from_srgb(texture.pixels[..., :3] / np.float64(255))
    expected = srgb_from_linear(linear.reshape(16, 4, 16, 4, 3).mean(axis=(1, 3))) * 255
    assert color is not None
    assert np.abs(color[..., :3] - expected).max() <= 1.5


@pytest.mark.parametrize(
    ("wrap", "index"),
    [
        ("repeat", np.arange(64) % 32),
        ("clamp", np.minimum(np.arange(64), 31)),
        ("mirror", np.r_[np.arange(32), np.arange(32)[::-1]]),
    ],
)
def test_uv_outside_the_texture_wrap(wrap: Wrap, index: np.ndarray) -> None:
    texture = noise_texture(32, wrap)
    color = render(quad(Material(texture=texture), repeat=2.0), [FRONT], 64, None).frames[0].color
    assert color is not None
    assert np.abs(color.astype(int) - texture.pixels[np.ix_(index, index)]).max() <= 1


def test_each_face_has_its_own_material() -> None:
    half = quad(Material()).vertices * 0.5
    vertices = np.concatenate([half - np.array([0.5, 0, 0]), half + np.array([0.5, 0, 0])]).astype(np.float32)
    faces = np.array([[0, 2, 1], [0, 3, 2], [4, 6, 5], [4, 7, 6]], np.int32)
    red, green = Material(base_color=(1.0, 0.0, 0.0, 1.0)), Material(base_color=(0.0, 1.0, 0.0, 1.0))
    mesh = Mesh(vertices, faces, np.array([0, 0, 1, 1], np.int32), (red, green))
    color = render(mesh, [FRONT], 16, None).frames[0].color
    assert color is not None
    assert (color[8, 2] == [255, 0, 0, 255]).all()
    assert (color[8, 13] == [0, 255, 0, 255]).all()


def test_base_color_and_vertex_colors_multiply_in_linear_light() -> None:
    mesh = quad(Material(base_color=(0.5, 0.25, 1.0, 1.0)))
    colors = np.full((4, 4), 0.5, np.float32)
    painted = Mesh(mesh.vertices, mesh.faces, mesh.face_material, mesh.materials, colors=colors)
    color = render(painted, [FRONT], 8, None).frames[0].color
    expected = np.round(srgb_from_linear(np.array([0.25, 0.125, 0.5])) * 255)
    assert color is not None
    assert np.abs(color[4, 4, :3] - expected).max() <= 1


def test_cutout_leaves_holes_and_shows_what_is_behind() -> None:
    pixels = np.full((4, 4, 4), 255, np.uint8)
    pixels[:, :2, 3] = 0
    mask = Material(texture=Texture(pixels, "clamp", "clamp"), alpha_mode="mask")
    view = render(quad(mask), [FRONT], 32, None).frames[0]
    assert view.color is not None
    assert view.depth is not None
    assert (view.color[:, :14, 3] == 0).all()
    assert (view.color[:, 18:, 3] == 255).all()
    assert ((view.depth > 0) == (view.color[..., 3] > 127)).mean() > 0.97


def test_edges_are_premultiplied() -> None:
    """Partly covered pixels keep the surface's own colour; only their alpha tells of the edge."""
    mesh = quad(Material(base_color=(1.0, 0.2, 0.2, 1.0)))
    turned = Camera("turned", FRONT.world_from_camera @ rotation_z(0.3), Orthographic(2.0))
    color = render(mesh, [turned], 50, None).frames[0].color
    assert color is not None
    partial = (color[..., 3] > 0) & (color[..., 3] < 255)
    assert partial.sum() > 20
    assert (np.ptp(color[color[..., 3] > 0][:, :3].astype(int), axis=0) <= 1).all()
    assert abs(color[..., 3].sum() / 255 / 2500 - 0.25) < 0.005  # the square covers a quarter of the picture


def rotation_z(angle: float) -> np.ndarray:
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return turn


def sphere() -> Mesh:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.9)
    normals = (ball.vertices / 0.9).astype(np.float32)
    faces = ball.faces.astype(np.int32)
    zeros = np.zeros(len(faces), np.int32)
    return Mesh(ball.vertices.astype(np.float32), faces, zeros, (Material(),), normals=normals)


@pytest.mark.parametrize("azimuth", [0.0, 2.0])
def test_sphere_normals_are_analytic(azimuth: float) -> None:
    camera = look_at_origin("a", direction_on_sphere(azimuth, 0.4), Orthographic())
    view = render(sphere(), [camera], 128, None).frames[0]
    assert view.normal is not None
    c = ((np.arange(128) + 0.5) / 64 - 1) / 0.9
    x, y = np.meshgrid(c, -c)
    inner = x**2 + y**2 < 0.9
    expected = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)[inner]
    cosine = (normal_from_bytes(view.normal)[inner] * expected).sum(-1)
    assert np.rad2deg(np.arccos(cosine.clip(-1, 1))).max() < 1.0


def test_ambient_is_the_cosine_integral() -> None:
    """Irradiance / pi of a smooth environment equals its integral over the hemisphere."""
    direction = np.array([[0.6, 0.0, 0.8]])
    ambient = ambient_from_lamps(direction, np.full((1, 3), 1.0), np.full(3, 0.2))

    def radiance(d: np.ndarray) -> float:  # the environment that the nine coefficients describe before the lobe
        lamp = np.pi * (harmonics(d[None]) @ harmonics(direction).T)[0, 0]
        return lamp + 0.2

    normal = np.array([0.0, 0.0, 1.0])

    def integrand(theta: float, phi: float) -> float:
        d = np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
        return radiance(d) * np.cos(theta) * np.sin(theta) / np.pi

    expected = dblquad(integrand, 0, 2 * np.pi, 0, np.pi / 2, epsabs=1e-6)[0]
    assert abs((harmonics(normal[None]) @ ambient)[0, 0] - expected) < 1e-4


def test_sun_is_lambertian_and_casts_a_shadow() -> None:
    """A plate in the sun is sun * cosine; below a smaller plate it is dark."""
    light = Light(np.zeros((9, 3)), np.array([0.0, -0.6, 0.8]), np.full(3, 0.5), softness=0.001)
    floor = quad(Material())
    flat = render(floor, [FRONT], 32, light).frames[0].color
    assert flat is not None
    assert np.abs(flat[16, 16, :3] - np.round(srgb_from_linear(np.full(3, 0.5 * 0.6)) * 255)).max() <= 1

    plate = np.array([[-0.3, -0.4, 0.5], [0.3, -0.4, 0.5], [0.3, -0.4, 0.2], [-0.3, -0.4, 0.2]], np.float32)
    vertices = np.concatenate([floor.vertices * 0.7, plate])
    faces = np.concatenate([floor.faces, floor.faces + 4])
    both = Mesh(vertices, faces, np.zeros(4, np.int32), (Material(),))
    view = render(both, [FRONT], 200, light).frames[0]
    assert view.color is not None
    # the sun falls by 0.8 / 0.6 per unit of depth: the shadow lies 0.4 * 4 / 3 below the plate
    low, high = 0.2 - 0.4 * 4 / 3, 0.5 - 0.4 * 4 / 3
    row = lambda z: int((1 - z) * 100)  # noqa: E731
    assert view.color[row((low + high) / 2), 100, 0] == 0
    assert view.color[row(low - 0.08), 100, 0] > 100
    assert view.color[row((low + high) / 2), 40, 0] > 100


def test_mip_levels_end_in_the_mean() -> None:
    pixels = noise_texture(64).pixels
    levels = mip_levels(pixels)
    assert [level.shape[0] for level in levels] == [64, 32, 16, 8, 4, 2, 1]
    mean = srgb_from_linear(linear_from_srgb(pixels[..., :3] / np.float64(255)).mean(axis=(0, 1))) * 255
    assert np.abs(levels[-1][0, 0, :3] - mean).max() < 1.5
    assert [level.shape[:2] for level in mip_levels(pixels[:5, :3])] == [(5, 3), (2, 1), (1, 1)]


def test_random_lights_are_varied_and_not_blown_out() -> None:
    white = sphere()
    means = []
    for seed in range(12):
        color = render(white, [FRONT], 24, random_light(np.random.default_rng(seed))).frames[0].color
        assert color is not None
        inside = color[color[..., 3] == 255][:, :3]
        means.append(inside.mean())
        assert (inside == 255).all(axis=1).mean() < 0.5
    assert 100 < np.mean(means) < 250
    assert np.std(means) > 5
    assert (harmonics(np.eye(3)) @ studio().ambient > 0).all()


@pytest.mark.cuda
def test_cuda_draws_what_the_cpu_draws() -> None:
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    mesh = quad(Material(texture=noise_texture(64)), repeat=1.7, tilt=0.4)
    for light in (None, studio()):
        host = render(mesh, [FRONT], 96, light).frames[0]
        card = render(mesh, [FRONT], 96, light, device="cuda:0").frames[0]
        assert host.color is not None
        assert card.color is not None
        assert host.depth is not None
        assert card.depth is not None
        assert np.abs(host.color.astype(int) - card.color).mean() < 0.5
        assert np.abs(host.depth - card.depth).max() < 1e-4
