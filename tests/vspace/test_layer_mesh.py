"""Triangles of a panorama's depth: closed, few on planes, right within the tolerance, torn at edges."""

import numpy as np
import pytest

from instant_ic.vspace.layer_mesh import corner_directions, layer_mesh

H, W = 64, 128


def pixel_directions(height=H, width=W):
    azimuth = np.pi - (np.arange(width) + 0.5) * 2 * np.pi / width
    elevation = np.pi / 2 - (np.arange(height) + 0.5) * np.pi / height
    flat = np.cos(elevation)[:, None]
    up = np.broadcast_to(np.sin(elevation)[:, None], (height, width))
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up], -1)


def room(height=H, width=W):
    """Inverse depth of a room of six planes, from its inside: the nearest plane in each direction."""
    planes = np.array(
        [(1 / 4, 0, 0), (-1 / 3, 0, 0), (0, 1 / 2, 0), (0, -1 / 2.5, 0), (0, 0, 1 / 1.5), (0, 0, -1 / 1.2)]
    )
    return (pixel_directions(height, width) @ planes.T).max(axis=-1).astype(np.float32)


def none(inverse):
    return np.zeros(inverse.shape, np.uint8)


def everywhere(inverse):
    return np.ones(inverse.shape, bool)


def solid_angles(mesh):
    """Signed solid angle of each triangle as the camera sees it (Van Oosterom and Strackee, 1983), (T,)."""
    directions = corner_directions(*mesh.size).astype(float)
    vertices = directions[mesh.corners[:, 1], mesh.corners[:, 0] % mesh.size[1]]
    a, b, c = (vertices[mesh.triangles[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    return 2 * np.arctan2(volume, 1 + (a * b).sum(1) + (b * c).sum(1) + (c * a).sum(1))


@pytest.mark.parametrize(("height", "width"), [(64, 128), (33, 66)])
def test_triangles_cover_the_sphere_once(height, width):
    inverse = room(height, width)
    angles = solid_angles(layer_mesh(inverse, none(inverse), everywhere(inverse)))
    assert angles.sum() == pytest.approx(-4 * np.pi, rel=1e-6)  # clockwise from outside: counter-clockwise from inside
    assert (angles < 1e-9).all()


def test_neighbours_share_their_vertices():
    inverse = room()
    mesh = layer_mesh(inverse, none(inverse), everywhere(inverse), 0.01)
    sides = {}
    pole = np.isin(mesh.corners[:, 1], (0, H))
    for triangle in mesh.triangles:
        for a, b in zip(triangle, np.roll(triangle, -1), strict=True):
            if not (pole[a] and pole[b]):
                sides[(a, b)] = sides.get((a, b), 0) + 1
    assert set(sides.values()) == {1}
    assert all((b, a) in sides for a, b in sides)


def test_a_plane_needs_few_triangles_and_a_room_is_right():
    floor = np.maximum(-pixel_directions()[..., 2] / 1.2, 0.02).astype(np.float32)
    few = layer_mesh(floor, none(floor), everywhere(floor), 0.004)
    assert len(few.triangles) < 0.25 * 2 * H * W
    inverse = room()
    mesh = layer_mesh(inverse, none(inverse), everywhere(inverse), 0.004)
    directions = corner_directions(H, W).astype(float)
    corners = directions[mesh.corners[:, 1], mesh.corners[:, 0] % W]
    places = corners / mesh.inverse_depth[:, None]
    middles = places[mesh.triangles].mean(axis=1)
    expected = (middles / np.linalg.norm(middles, axis=1, keepdims=True)) @ np.array(
        [(1 / 4, 0, 0), (-1 / 3, 0, 0), (0, 1 / 2, 0), (0, -1 / 2.5, 0), (0, 0, 1 / 1.5), (0, 0, -1 / 1.2)]
    ).T
    errors = np.abs(1 / np.linalg.norm(middles, axis=1) - expected.max(axis=1))
    share = -solid_angles(mesh) / (4 * np.pi)
    assert share[errors < 0.004].sum() > 0.9 and errors.max() < 0.03  # the room's edges lie inside pixels


def test_a_pixel_at_an_edge_keeps_its_own_depth():
    inverse = np.full((H, W), 0.5, np.float32)
    inverse[20:40, 50:70] = 1.0
    edges = np.zeros((H, W), np.uint8)
    edges[19, 49:70] = edges[39, 49:70] = 1
    edges[19:40, 49] = edges[19:40, 69] = 1
    mesh = layer_mesh(inverse, edges, everywhere(inverse))
    assert set(np.unique(mesh.inverse_depth)) == {np.float32(0.5), np.float32(1.0)}  # nothing spans the edge
    values = mesh.inverse_depth[mesh.triangles]
    assert (values.min(axis=1) == values.max(axis=1)).all()
    assert solid_angles(mesh).sum() == pytest.approx(-4 * np.pi, rel=1e-6)


def test_what_is_not_shown_has_no_triangles():
    inverse = room()
    shown = everywhere(inverse)
    shown[10:30, :40] = False
    mesh = layer_mesh(inverse, none(inverse), shown)
    rows = np.sin(np.pi / 2 - np.arange(H + 1) * np.pi / H)
    gone = (rows[10] - rows[30]) * 40 * 2 * np.pi / W
    # The sides of the lattice's squares are great circles, those of its rows are not.
    assert solid_angles(mesh).sum() == pytest.approx(-(4 * np.pi - gone), rel=2e-3)
    assert len(layer_mesh(inverse, none(inverse), ~everywhere(inverse)).triangles) == 0


@pytest.mark.parametrize("bad", [0.0, np.nan])
def test_bad_depth_is_refused(bad):
    inverse = room()
    inverse[3, 4] = bad
    with pytest.raises(ValueError, match="finite and > 0"):
        layer_mesh(inverse, none(inverse), everywhere(inverse))
    with pytest.raises(ValueError, match="differ"):
        layer_mesh(inverse[:, :-1], none(inverse), everywhere(inverse))
