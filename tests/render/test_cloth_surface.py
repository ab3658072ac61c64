"""Normals of cloth."""

import numpy as np

from render.cloth import vertex_normals


def wavy_sheet(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z = sin(2 x) / 4 on the unit square, n cells a side: vertices, triangles, exact normals."""
    j, i = (each.ravel() for each in np.mgrid[0 : n + 1, 0 : n + 1])
    x, y = i / n, j / n
    a = (np.arange(n) + (n + 1) * np.arange(n)[:, None]).ravel()
    triangles = np.concatenate([np.stack([a, a + 1, a + n + 2], 1), np.stack([a, a + n + 2, a + n + 1], 1)])
    normals = np.stack([-np.cos(2 * x) / 2, np.zeros_like(x), np.ones_like(x)], axis=1)
    return np.stack([x, y, np.sin(2 * x) / 4], 1), triangles, normals / np.linalg.norm(normals, axis=1)[:, None]


def largest_angle(n: int) -> float:
    vertices, triangles, exact = wavy_sheet(n)
    normals = vertex_normals(vertices, triangles)
    inner = (vertices[:, :2] > 0).all(axis=1) & (vertices[:, :2] < 1).all(axis=1)
    cosine = np.einsum("ij,ij->i", normals.astype(float), exact)[inner]
    return float(np.arccos(np.clip(cosine, -1, 1)).max())


def test_normals_converge_to_those_of_the_smooth_surface():
    coarse, fine = largest_angle(10), largest_angle(20)
    # Means over a symmetric neighbourhood are of second order: a quarter of the error; a third leaves room for higher
    # orders on the coarse sheet.
    assert fine < coarse / 3
    assert fine < np.radians(0.5)


def test_a_vertex_without_an_area_around_it_gets_a_normal_all_the_same():
    vertices = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5]]
    np.testing.assert_array_equal(vertex_normals(vertices, [[0, 1, 2]]), [[0, 0, 1]] * 4)


def test_normals_have_unit_length_and_follow_the_side_of_the_triangles():
    vertices, triangles, _ = wavy_sheet(6)
    normals = vertex_normals(vertices, triangles)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=2e-7)  # float32
    np.testing.assert_array_equal(vertex_normals(vertices, triangles[:, ::-1]), -normals)
