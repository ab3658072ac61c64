"""The step of `mpm3d_ggui.py` of Taichi 1.7's examples (Apache License 2.0), of jelly alone."""

import numpy as np
import taichi as ti
from numpy.typing import NDArray

BOUND = 3


@ti.data_oriented
class Example:
    """Particles in a unit cube of `n_grid` cells along an edge."""

    def __init__(self, places: NDArray[np.float32], n_grid: int) -> None:
        n = len(places)
        self.n_grid, self.dx, self.dt = n_grid, 1.0 / n_grid, 2.0e-4 * 64 / n_grid
        self.p_vol, self.p_mass = (0.5 / n_grid) ** 2, (0.5 / n_grid) ** 2
        self.mu, self.la = 0.3 * 1000.0 / 2.4, 0.3 * 200.0 / (1.2 * 0.6)
        self.x, self.v = ti.Vector.field(3, float, n), ti.Vector.field(3, float, n)
        self.C, self.F = ti.Matrix.field(3, 3, float, n), ti.Matrix.field(3, 3, float, n)
        self.Jp = ti.field(float, n)
        self.grid_v = ti.Vector.field(3, float, (n_grid,) * 3)
        self.grid_m = ti.field(float, (n_grid,) * 3)
        self.x.from_numpy(places)
        self.F.from_numpy(np.tile(np.eye(3, dtype=np.float32), (n, 1, 1)))
        self.Jp.fill(1.0)

    @ti.kernel
    def step(self):
        for i in ti.grouped(self.grid_m):
            self.grid_v[i] = ti.zero(self.grid_v[i])
            self.grid_m[i] = 0
        for p in self.x:
            place = self.x[p] / self.dx
            base = int(place - 0.5)
            fx = place - base
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2]
            self.F[p] = (ti.Matrix.identity(float, 3) + self.dt * self.C[p]) @ self.F[p]
            u, sig, v = ti.svd(self.F[p])
            j = 1.0
            for d in ti.static(range(3)):
                new_sig = sig[d, d]
                self.Jp[p] *= sig[d, d] / new_sig
                sig[d, d] = new_sig
                j *= new_sig
            stress = 2 * self.mu * (self.F[p] - u @ v.transpose()) @ self.F[p].transpose() + ti.Matrix.identity(
                float, 3
            ) * self.la * j * (j - 1)
            stress = (-self.dt * self.p_vol * 4) * stress / self.dx**2
            affine = stress + self.p_mass * self.C[p]
            for offset in ti.static(ti.grouped(ti.ndrange(3, 3, 3))):
                dpos = (offset - fx) * self.dx
                weight = 1.0
                for i in ti.static(range(3)):
                    weight *= w[offset[i]][i]
                self.grid_v[base + offset] += weight * (self.p_mass * self.v[p] + affine @ dpos)
                self.grid_m[base + offset] += weight * self.p_mass
        for i in ti.grouped(self.grid_m):
            if self.grid_m[i] > 0:
                self.grid_v[i] /= self.grid_m[i]
            self.grid_v[i] += self.dt * ti.Vector([0.0, -9.8, 0.0])
            cond = (i < BOUND) & (self.grid_v[i] < 0) | (i > self.n_grid - BOUND) & (self.grid_v[i] > 0)
            self.grid_v[i] = ti.select(cond, 0, self.grid_v[i])
        for p in self.x:
            place = self.x[p] / self.dx
            base = int(place - 0.5)
            fx = place - base
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2]
            new_v = ti.zero(self.v[p])
            affine = ti.zero(self.C[p])
            for offset in ti.static(ti.grouped(ti.ndrange(3, 3, 3))):
                dpos = (offset - fx) * self.dx
                weight = 1.0
                for i in ti.static(range(3)):
                    weight *= w[offset[i]][i]
                g_v = self.grid_v[base + offset]
                new_v += weight * g_v
                affine += 4 * weight * g_v.outer_product(dpos) / self.dx**2
            self.v[p] = new_v
            self.x[p] += self.dt * self.v[p]
            self.C[p] = affine
