"""Trial of the next cloth solver on a square sheet of springs: small steps, exact threads, contacts that cannot cross.

What `benchmarks.cloth_gates` measures, before the solver of `sim.cloth` is written anew; it goes when that one stands.

A step moves node i by u_i. Threads of warp and weft are solved exactly (tridiagonal, XPBD after Macklin et al. 2016,
once in a small step, Macklin et al. 2019) against the bodies that nodes lie on, and implicitly across the thread, where
its tension is a stiffness; bends and shears by relaxation. Contacts and springs beyond a limit push in two Jacobi
iterations, and threads are solved again. Then every pair that might meet is tested: with n the normal between the
closest points at the start, both sides stay apart if min n.(x_a + u_a) - max n.(x_b + u_b) is positive at the end, as
both are linear in time. What fails goes through further rounds.

A substep is one step, but one that leaves a spring too long, or a pair that fails, is taken again with half the length.
At the least length what fails moves as one, in zones that only grow (Bridson et al. 2002), so that it ends: nodes with
one displacement do not meet.

Pairs are listed for some substeps: those that get within the thickness if nodes go on as they do now, each at most a
margin from there. A list holds as long as all nodes are that near to where they were foreseen, which is tested at the
end of every step; whatever is common to a pair's motion costs nothing.
"""

import math

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.proximity import closest_on_edges, closest_on_triangle

SIDE, DENSITY, GRAVITY = 1.0, 0.3, 9.81
"""Length of the sheet's sides [m], mass per area [kg/m²], acceleration [m/s²]."""

STRETCH, SHEAR, BEND = 4.0e3, 50.0, 8.0e-6
"""Stiffness of cotton [N/m], [N/m], [N m]."""

SOFT_IN_COMPRESSION = 10.0
"""Threads give way so many times as easily when pressed: they buckle below the length of an edge."""

FRICTION, DRAG = 0.5, 0.1
"""Coulomb's coefficient [-]; part of the speed lost in a second [1/s]."""

RECOVERY_TIME_S = 0.01
"""Layers that are too near go apart within about this time."""

THICKNESS, MARGIN, LEAST_GAP = 0.5, 0.1, 0.01
"""Distance that layers keep, how far nodes may get from where they were foreseen, and what contacts never go below, in
edges."""

NEAR, RATE = 0.1, 0.3
"""Layers nearer than this, in edges, go apart by this part of what is missing in a step."""

STRAIN_LIMIT = 0.02
"""Springs beyond this pull along with the contacts."""

MOST_STRAIN, LITTLE_STRAIN, LEAST_PART = 0.04, 0.024, 0.125
"""A step that leaves a spring beyond the first is taken again with half the length, down to this part of a substep;
below the second the next is twice as long."""

FULL_ROUNDS, ROUNDS = 4, 8
"""Rounds for pairs that fail: first of contacts and threads, then, up to so many in all, of what fails alone."""

SQUEEZED = 0.8
"""Cells with a shorter side or diagonal, in edges, count as bent."""

BALL_RADIUS, BALL_FLOOR = 0.25, -0.4
FUNNEL_RADIUS, FUNNEL_FLOOR = 0.12, -0.35
"""The ball is about the origin; the funnel is a tube below a cone of 45 degrees. All [m]."""

COLUMN_GAP, TURNS_PER_S, SHORTENING_SPEED, SHORTENING = 0.03, 0.5, 0.12, 0.3
"""Of the column: gap of its seam, in its girth; turns of each end [1/s], in opposite directions; how fast [m/s] and how
far [m] each end moves inwards."""

PATCH_PAIRS = 48
"""Patches with more neighbours than this are looked at as a whole."""

FINER = 2.0**-22
"""Unit of summed corrections, in edges: integers, so that their order does not matter."""

TALLY = ("steps", "back", "searches", "rounds", "zoned_steps", "largest_zone", "unresolved", "contacts")
"""What is counted in a frame: `back` are steps that were taken again, which count as steps, too; the largest zone in
nodes; `unresolved` are pairs that held nodes are led through."""

vec3, vec4, ivec4 = ti.math.vec3, ti.math.vec4, ti.math.ivec4


def start_of(scene: str, n: int) -> NDArray[np.float32]:
    """Positions of the n x n nodes [m], (n * n, 3)."""
    along = np.linspace(-0.5 * SIDE, 0.5 * SIDE, n)
    y, x = (each.ravel() for each in np.meshgrid(along, along, indexing="ij"))
    if scene == "ball":
        return np.stack([x, y, np.full(n * n, 0.3)], axis=1).astype(np.float32)
    if scene == "funnel":  # a little uneven, so that it crumples instead of folding as one
        return np.stack([x, y, 0.75 + 0.02 * np.sin(9 * x + 4 * y) * np.cos(7 * y)], axis=1).astype(np.float32)
    radius = SIDE / (2.0 * np.pi * (1.0 - COLUMN_GAP))
    return np.stack([x, radius * np.cos(y / radius), radius * np.sin(y / radius)], axis=1).astype(np.float32)


@ti.data_oriented
class TrialSheet:
    """The sheet.

    Attributes:
        count: of listed pairs.
        step_s: length of the last step, which kernels read in `dt`.
        tally: what happened since `begin_frame`, by name.

    Args:
        scene: "ball", "funnel" or "twist".
        n: nodes along a side, a power of two on a GPU.
        substeps: in a frame of 1/60 s.
        on_gpu: threads are solved by parallel cyclic reduction there, and one after the other by elimination elsewhere.
        every: substeps that a list is meant for.
        room: of the list, in pairs a node.
    """

    def __init__(self, scene: str, n: int, *, substeps: int, on_gpu: bool, every: int, room: int) -> None:
        self.scene, self.n, self.on_gpu, self.every = scene, n, on_gpu, every
        self.h = SIDE / (n - 1)
        self.substep_s, self.dt = 1.0 / 60.0 / substeps, ti.field(ti.f32, ())
        self.thickness, self.margin, self.least_gap = THICKNESS * self.h, MARGIN * self.h, LEAST_GAP * self.h
        self.quantum, self.inverse_mass = FINER * self.h, 1.0 / (DENSITY * self.h**2)
        self.cell = 3.0 * self.h
        nodes = n * n
        self.nodes, self.capacity = nodes, max(1 << 18, room * nodes)
        self.buckets = 1 << math.ceil(math.log2(4 * nodes))
        self.patch = 4 if n <= 160 else 8
        self.patches_a_side = -(-n // self.patch)
        self.patches = self.patches_a_side**2
        self.lanes = 64 if on_gpu else 1
        # Nodes: where they are, displacement of the step, and what both were before it; scratch; where the last search
        # saw them, and how they moved in a substep; normal of the body that holds each, and how far threads press there
        self.x, self.u, self.kept_x, self.kept_u, self.scratch, self.seen, self.foreseen, self.start, self.block = (
            ti.Vector.field(3, ti.f32, nodes) for _ in range(9)
        )
        self.w, self.pressure = ti.field(ti.f32, nodes), ti.field(ti.f32, nodes)
        self.sums, self.pushes = ti.Vector.field(3, ti.i32, nodes), ti.field(ti.i32, nodes)
        self.multiplier = ti.field(ti.f32, (2, nodes))
        self.direction = ti.Vector.field(3, ti.f32, nodes)
        self.upper, self.right = ti.field(ti.f32, nodes), ti.field(ti.f32, nodes)
        # Cells, each by its first node: box, box of its way, normal, motion and how far corners differ from it.
        self.low, self.high, self.way_low, self.way_high, self.normal, self.motion = (
            ti.Vector.field(3, ti.f32, nodes) for _ in range(6)
        )
        self.spread = ti.field(ti.f32, nodes)
        self.is_bent, self.is_active, self.slot, self.entry = (ti.field(ti.i32, nodes) for _ in range(4))
        self.bucket_count, self.bucket_start = ti.field(ti.i32, self.buckets), ti.field(ti.i32, self.buckets)
        self.patch_low, self.patch_high, self.axis = (ti.Vector.field(3, ti.f32, self.patches) for _ in range(3))
        self.half_angle = ti.field(ti.f32, self.patches)
        self.near_count, self.is_flat = ti.field(ti.i32, self.patches), ti.field(ti.i32, self.patches)
        self.near = ti.field(ti.i32, (self.patches, PATCH_PAIRS))
        # Pairs: a node and a triangle, or the ends of two edges; weights of the closest points; normal and distance.
        self.pair, self.is_edges = ti.Vector.field(4, ti.i32, self.capacity), ti.field(ti.i32, self.capacity)
        self.weights, self.plane = (ti.Vector.field(4, ti.f32, self.capacity) for _ in range(2))
        # Zones: the least node of each, its momentum over the mass of a node, how many nodes, and one that is held.
        self.zone, self.zone_count, self.zone_held = (ti.field(ti.i32, nodes) for _ in range(3))
        self.zone_sum = ti.Vector.field(3, ti.i64, nodes)
        # Counters: listed pairs, hashed cells, what failed, what was pushed, what changed, half of the widest way, how
        # far nodes stray from where they were foreseen, in `quantum`, and the worst strain, in 1e-6.
        self.counter = ti.field(ti.i32, 8)
        self.strayed, self.strains = ti.field(ti.i32, 64), ti.field(ti.i32, 64)
        self.mean_sums, self.mean = ti.Vector.field(3, ti.i64, 64), ti.Vector.field(3, ti.f32, 1)
        inverse_mass = np.full((n, n), self.inverse_mass, dtype=np.float32)
        if scene == "twist":
            inverse_mass[:, [0, -1]] = 0.0
        self.w.from_numpy(inverse_mass.ravel())
        for field in (self.x, self.start):
            field.from_numpy(start_of(scene, n))
        self.count, self._age, self._part, self.step_s = 0, float(every), 1.0, self.substep_s
        self._strayed = self._strain = self._time = 0.0
        self.tally: dict[str, int] = {}
        self.begin_frame()

    def begin_frame(self) -> None:
        """Count anew."""
        self.tally = dict.fromkeys(TALLY, 0)

    def positions(self) -> NDArray[np.float32]:
        """Where nodes are [m], (n * n, 3)."""
        return self.x.to_numpy() + self.u.to_numpy()

    # --- the substep ------------------------------------------------------------------------------------------------

    def substep(self) -> None:
        """Advance by `substep_s`."""
        left = 1.0
        while left > 0:
            time, before, part = self._time, self.step_s, self._part
            self.tally["steps"] += 1
            if self._step() or part == LEAST_PART:
                left -= part
                if self._strain < LITTLE_STRAIN and part < 1.0 and left % (2 * part) == 0:
                    self._part = 2 * part
            else:
                self.tally["back"] += 1
                self.x.copy_from(self.kept_x)
                self.u.copy_from(self.kept_u)
                self._time, self.step_s, self._part, self._strayed = time, before, 0.5 * part, math.inf

    def _step(self) -> bool:
        """Advance by a part of a substep; returns whether no spring is too long, and pairs are apart without zones."""
        before, self.step_s = self.step_s, self._part * self.substep_s
        self.dt[None] = self.step_s
        self.predict(self._time, before)
        self._time += self.step_s
        self.solve_threads()
        if self._age >= self.every or self._strayed > self.margin:
            self._look(self.every)
        else:
            self.touch(self.count)
        found = self._push()
        self.solve_threads()
        for _ in range(3):  # pushed beyond what was foreseen: look at what is near these ways
            if self._strayed <= self.margin:
                break
            self._look(self._part)
            found = self._push()
        self.tally["contacts"] = max(self.tally["contacts"], found)
        are_apart = self._keep_apart()
        if not are_apart and self._part == LEAST_PART:
            self._move_as_one()
        self._age += self._part
        return are_apart and self._strain <= MOST_STRAIN

    def _push(self) -> int:
        found, strayed = self.push(self.count, self._age + self._part)
        self._strayed = strayed * self.quantum
        return int(found)

    def _look(self, substeps: float) -> None:
        self.count, self._age = int(self.search(substeps, self._part)), 0.0
        self.tally["searches"] += 1
        if self.count > self.capacity:
            raise SystemExit(f"{self.count} pairs, room for {self.capacity}: give more --room")
        self.touch(self.count)

    def _test(self, *, gives: bool = False) -> int:
        failed, strayed, strain = self.test(self.count, self._age + self._part, int(gives))
        self._strayed, self._strain = strayed * self.quantum, 1e-6 * strain
        return int(failed)

    def _keep_apart(self) -> bool:
        """Go through rounds until every pair is known not to cross; returns whether that is so."""
        for number in range(ROUNDS + 1):
            failed = self._test(gives=FULL_ROUNDS <= number < ROUNDS)
            if not failed and self._strayed <= self.margin:
                return True
            if number < ROUNDS:
                self.tally["rounds"] += 1
                if not failed:
                    self._look(self._part)
                elif number < FULL_ROUNDS:
                    self._push()
                    self.solve_threads()
                else:
                    self.push_again(self.count)
        return False

    def _move_as_one(self) -> None:
        """Join what fails in zones until no pair does."""
        self.zone.from_numpy(np.arange(self.nodes, dtype=np.int32))
        self.tally["zoned_steps"] += 1
        while True:
            grew = False
            while self.join(self.count):
                grew = True
            self.move_zones()
            failed = self._test()
            if not failed:
                if self._strayed <= self.margin:
                    break
                self._look(self._part)
            elif not grew:  # held nodes are led through each other
                self.tally["unresolved"] += failed
                break
        self.tally["largest_zone"] = max(self.tally["largest_zone"], int(np.bincount(self.zone.to_numpy()).max()))

    # --- springs ----------------------------------------------------------------------------------------------------

    @ti.func
    def keep_out(self, i):
        """Lead a node out of the ball, the funnel or the floor, which block it, with friction."""
        if self.w[i] > 0:
            p = self.x[i] + self.u[i]
            depth, n = 1.0, vec3(0, 0, 1)
            if ti.static(self.scene == "ball"):
                depth, n = p.norm() - BALL_RADIUS - self.thickness, p.normalized()
                above = p.z - BALL_FLOOR - self.thickness
                if above < depth:
                    depth, n = above, vec3(0, 0, 1)
            elif ti.static(self.scene == "funnel"):
                r = ti.max(p.xy.norm(), 1e-9)
                depth, n = FUNNEL_RADIUS - r, vec3(-p.x / r, -p.y / r, 0)
                if p.z > 0:
                    depth, n = (FUNNEL_RADIUS + p.z - r) * ti.sqrt(0.5), vec3(-p.x / r, -p.y / r, 1) * ti.sqrt(0.5)
                depth -= self.thickness
                above = p.z - FUNNEL_FLOOR - self.thickness
                if above < depth:
                    depth, n = above, vec3(0, 0, 1)
            if depth < 0:
                self.u[i] -= depth * n
                self.block[i] = n
                slip = self.u[i] - self.u[i].dot(n) * n
                length = slip.norm()
                if length > 0:
                    self.u[i] -= slip * ti.min(1.0, FRICTION * (self.pressure[i] - depth) / length)
                self.pressure[i] = 0.0

    @ti.func
    def held(self, i, time):
        """Displacement of an end of the column."""
        side = ti.select(i % self.n == 0, 1.0, -1.0)
        angle = side * 2.0 * math.pi * TURNS_PER_S * time
        p = self.start[i]
        c, s = ti.cos(angle), ti.sin(angle)
        inwards = side * ti.min(SHORTENING_SPEED * time, SHORTENING)
        return vec3(p.x + inwards, p.y * c - p.z * s, p.y * s + p.z * c) - self.x[i]

    @ti.func
    def bend(self, i, stride):
        """Second difference of where nodes are led."""
        of_start = self.x[i - stride] + self.x[i + stride] - 2 * self.x[i]
        return of_start + (self.u[i - stride] + self.u[i + stride] - 2 * self.u[i])

    @ti.func
    def shear(self, i, j):
        """Solve a diagonal."""
        d = self.x[j] + self.u[j] - self.x[i] - self.u[i]
        length, weight = d.norm(), self.w[i] + self.w[j]
        if weight > 0 and length > 1e-9:
            s = (length - ti.sqrt(2.0) * self.h) / (weight + 1.0 / (SHEAR * self.dt[None] ** 2)) / length
            self.u[i] += self.w[i] * s * d
            self.u[j] -= self.w[j] * s * d

    @ti.kernel
    def predict(self, time: ti.f32, before: ti.f32):
        """Where inertia, gravity, bends and shears lead; the step before took `before`."""
        n, dt = ti.static(self.n), self.dt[None]
        stiffness = ti.static(BEND / self.h**2)
        for i in range(self.nodes):
            self.kept_x[i], self.kept_u[i] = self.x[i], self.u[i]
            self.x[i] += self.u[i]
            if self.w[i] > 0:
                self.u[i] = dt * (self.u[i] / before) * (1.0 - DRAG * dt) - vec3(0, 0, GRAVITY * dt**2)
            self.sums[i], self.pushes[i] = 0, 0
            self.multiplier[0, i], self.multiplier[1, i] = 0.0, 0.0
            self.block[i], self.pressure[i] = vec3(0), 0.0
            self.keep_out(i)
            if self.w[i] == 0:
                self.u[i] = self.held(i, time + dt)
        for i in range(self.nodes):
            force, curl = vec3(0), vec3(0)
            if self.w[i] > 0:
                for stride in ti.static((1, self.n)):
                    q = i % n if ti.static(stride == 1) else i // n
                    if q > 0 and q < n - 1:
                        force -= 2 * self.bend(i, stride)
                        curl -= 2 * (self.u[i - stride] + self.u[i + stride] - 2 * self.u[i])
                    if q > 1:
                        force += self.bend(i - stride, stride)
                        curl += self.u[i - 2 * stride] + self.u[i] - 2 * self.u[i - stride]
                    if q < n - 2:
                        force += self.bend(i + stride, stride)
                        curl += self.u[i] + self.u[i + 2 * stride] - 2 * self.u[i + stride]
            share = self.inverse_mass / (6.0 * self.inverse_mass + 1.0 / (stiffness * dt**2))
            self.scratch[i] = self.u[i] - 0.25 * share * force - 0.02 * curl
        for i in range(self.nodes):
            self.u[i] = self.scratch[i]
        for k in ti.static(range(4)):  # both diagonals, every second row of cells
            for q in range(((n - k % 2) // 2) * n):
                r, c = 2 * (q // n) + k % 2, q % n
                if c < n - 1 and r < n - 1:
                    i = r * n + c
                    if ti.static(k < 2):
                        self.shear(i, i + n + 1)
                    else:
                        self.shear(i + 1, i + n)

    @ti.kernel
    def solve_threads(self):
        """All threads of the warp, then of the weft."""
        for along in ti.static((1, 0)):
            if ti.static(self.on_gpu):
                self.reduce_threads(along)
            else:
                self.eliminate_threads(along)

    @ti.func
    def node_of(self, thread, j, along: ti.template()):
        return thread * self.n + j if ti.static(along == 0) else j * self.n + thread

    @ti.func
    def compliance(self, thread, length):
        """Of a spring over dt²; threads on the edge have half as much cloth."""
        of_edge = ti.select((thread == 0) | (thread == self.n - 1), 2.0, 1.0)
        return of_edge * ti.select(length < self.h, SOFT_IN_COMPRESSION, 1.0) / (STRETCH * self.dt[None] ** 2)

    @ti.func
    def yields(self, i, d, e):
        """d.w(I - b b^T)e: how far an impulse along e moves a node along d that a body with the normal b holds."""
        b = self.block[i]
        return self.w[i] * (d.dot(e) - d.dot(b) * b.dot(e))

    @ti.func
    def stiffness_across(self, along: ti.template(), i):
        """w l / h of the spring after a node: what its tension does against moves across the thread."""
        return self.inverse_mass * ti.max(0.0, self.multiplier[along, i]) / self.h

    @ti.func
    def change(self, i, impulse):
        """Move a node by what its threads do to it; a body holds it, until they pull it away from there."""
        inwards = impulse.dot(self.block[i])
        if inwards < 0:
            impulse -= inwards * self.block[i]
            self.pressure[i] -= self.w[i] * inwards
        elif inwards > 0:
            self.block[i] = vec3(0)
        self.u[i] += self.w[i] * impulse

    @ti.func
    def eliminate_threads(self, along: ti.template()):
        """Multipliers l by elimination: with W = w (I - b b^T), a the compliance and L the sum of earlier solutions,

        n_j.(W_j + W_j+1) n_j l_j + a l_j - n_j.W_j n_j-1 l_j-1 - n_j.W_j+1 n_j+1 l_j+1 = C_j - a L_j.

        What they do to a node across the thread, d_j, becomes e_j + g_j-1 (e_j - e_j-1) + g_j (e_j - e_j+1) = d_j, with
        the stiffness g.
        """
        n = ti.static(self.n)
        for thread in range(n):
            before, diagonal, right = vec3(0), 1.0, 0.0
            for j in range(n - 1):
                i, other, k = self.node_of(thread, j, along), self.node_of(thread, j + 1, along), thread * n + j
                d = self.x[other] + self.u[other] - self.x[i] - self.u[i]
                length = ti.max(d.norm(), 1e-9)
                direction, a = d / length, self.compliance(thread, length)
                off = -self.yields(i, direction, before)
                self.upper[k] = off / diagonal
                diagonal = a + self.yields(i, direction, direction) + self.yields(other, direction, direction)
                diagonal -= off * self.upper[k]
                right = (length - self.h - a * self.multiplier[along, i] - off * right) / diagonal
                self.right[k], self.direction[k], before = right, direction, direction
            after, n_after, stiff_after, carried, factor = 0.0, vec3(0), 0.0, vec3(0), 0.0
            for reverse in range(n):
                j = n - 1 - reverse
                i, k = self.node_of(thread, j, along), thread * n + j
                own, direction, stiff = 0.0, vec3(0), 0.0
                if j > 0:
                    own, direction = self.right[k - 1] - self.upper[k] * after, self.direction[k - 1]
                    other = self.node_of(thread, j - 1, along)
                    self.multiplier[along, other] += own
                    stiff = self.stiffness_across(along, other)
                impulse, tangent = after * n_after - own * direction, (n_after + direction).normalized(1e-9)
                self.scratch[k] = impulse.dot(tangent) * tangent
                free = ti.select(self.w[i] == 0, 0.0, 1.0)
                pivot = 1.0 + stiff_after * (1.0 - factor) + stiff
                carried = free * (impulse - self.scratch[k] + stiff_after * carried) / pivot
                factor = free * stiff / pivot
                self.upper[k], self.direction[k] = factor, carried
                after, n_after, stiff_after = own, direction, stiff
            across = vec3(0)
            for j in range(n):
                k = thread * n + j
                across = self.direction[k] + self.upper[k] * across
                self.change(self.node_of(thread, j, along), self.scratch[k] + across)

    @ti.func
    def reduce_threads(self, along: ti.template()):
        """The same by parallel cyclic reduction, a block of the GPU for each thread of the sheet."""
        n = ti.static(self.n)
        ti.loop_config(block_dim=self.n)
        for g in range(self.nodes):
            thread, j = g // n, g % n
            i, other = self.node_of(thread, j, along), self.node_of(thread, ti.min(j + 1, n - 1), along)
            sa, sb = ti.simt.block.SharedArray((self.n,), ti.f32), ti.simt.block.SharedArray((self.n,), ti.f32)
            sc, sx = ti.simt.block.SharedArray((self.n,), ti.f32), ti.simt.block.SharedArray((self.n,), ti.f32)
            sy, sz = ti.simt.block.SharedArray((self.n,), ti.f32), ti.simt.block.SharedArray((self.n,), ti.f32)
            d = self.x[other] + self.u[other] - self.x[i] - self.u[i]
            length = ti.max(d.norm(), 1e-9)
            direction, before = d / length, vec3(0)
            sx[j], sy[j], sz[j] = direction.x, direction.y, direction.z
            ti.simt.block.sync()
            if j > 0:
                before = vec3(sx[j - 1], sy[j - 1], sz[j - 1])
            a, b, c, r = 0.0, 1.0, 0.0, 0.0
            if j < n - 1:
                compliance = self.compliance(thread, length)
                a = -self.yields(i, direction, before)
                b = compliance + self.yields(i, direction, direction) + self.yields(other, direction, direction)
                c = -self.yields(other, direction, vec3(sx[j + 1], sy[j + 1], sz[j + 1]))
                r = length - self.h - compliance * self.multiplier[along, i]
            own = self.reduce(j, a, b, c, vec3(r, 0, 0), (sa, sb, sc, sx, sy, sz)).x
            self.multiplier[along, i] += own
            stiff, own_before, stiff_before = self.stiffness_across(along, i), 0.0, 0.0
            sa[j], sb[j] = own, stiff
            ti.simt.block.sync()
            if j > 0:
                own_before, stiff_before = sa[j - 1], sb[j - 1]
            impulse, tangent = own * direction - own_before * before, (direction + before).normalized(1e-9)
            along_thread = impulse.dot(tangent) * tangent
            a, b, c, across = 0.0, 1.0, 0.0, vec3(0)
            if self.w[i] > 0:
                a, b, c, across = -stiff_before, 1.0 + stiff_before + stiff, -stiff, impulse - along_thread
            self.change(i, along_thread + self.reduce(j, a, b, c, across, (sa, sb, sc, sx, sy, sz)))

    @ti.func
    def reduce(self, j, a, b, c, e, shared: ti.template()):
        """u of a_j u_j-1 + b_j u_j + c_j u_j+1 = e_j, a row for each thread of the block that has `shared`."""
        sa, sb, sc, sx, sy, sz = shared
        s = 1
        ti.simt.block.sync()
        while s < self.n:
            sa[j], sb[j], sc[j], sx[j], sy[j], sz[j] = a, b, c, e.x, e.y, e.z
            ti.simt.block.sync()
            if j - s >= 0:
                f = -a / sb[j - s]
                b, e, a = b + f * sc[j - s], e + f * vec3(sx[j - s], sy[j - s], sz[j - s]), f * sa[j - s]
            else:
                a = 0.0
            if j + s < self.n:
                f = -c / sb[j + s]
                b, e, c = b + f * sa[j + s], e + f * vec3(sx[j + s], sy[j + s], sz[j + s]), f * sc[j + s]
            else:
                c = 0.0
            ti.simt.block.sync()
            s *= 2
        return e / b

    # --- the search -------------------------------------------------------------------------------------------------

    @ti.func
    def cell_of(self, p):
        return ti.cast(ti.floor(p / self.cell), ti.i32)

    @ti.func
    def bucket_of(self, cell):
        return ((cell[0] * 73856093) ^ (cell[1] * 19349663) ^ (cell[2] * 83492791)) & (self.buckets - 1)

    @ti.func
    def closest(self, q, is_edges):
        """Weights of the nodes of a pair in the vector between its closest points."""
        x = self.x[q[0]]
        b, c, d = self.x[q[1]] - x, self.x[q[2]] - x, self.x[q[3]] - x
        found = vec4(0)
        if is_edges == 0:
            o = closest_on_triangle(vec3(0), b, c, d)
            found = vec4(1, -o[0], -o[1], -o[2])
        else:
            o = closest_on_edges(vec3(0), b, c, d)
            found = vec4(1 - o[0], o[0], o[1] - 1, -o[1])
        return found

    @ti.func
    def between(self, p, q):
        """Vector between the closest points of a pair at the start."""
        k = self.weights[p]
        return k[0] * self.x[q[0]] + k[1] * self.x[q[1]] + k[2] * self.x[q[2]] + k[3] * self.x[q[3]]

    @ti.func
    def relative(self, of: ti.template(), q, is_edges):
        """How far vectors of the two sides of a pair differ at most."""
        a, b, c, d = of[q[0]], of[q[1]], of[q[2]], of[q[3]]
        most = ti.max((a - c).norm_sqr(), (a - d).norm_sqr())
        if is_edges == 1:
            most = ti.max(most, (b - c).norm_sqr(), (b - d).norm_sqr())
        else:
            most = ti.max(most, (a - b).norm_sqr())
        return ti.sqrt(most)

    @ti.func
    def consider(self, q, is_edges, most, steps):
        """List a pair that may get within the thickness; `most` bounds for all of two cells how near that is."""
        x0, x1, x2, x3 = self.x[q[0]], self.x[q[1]], self.x[q[2]], self.x[q[3]]
        low_a, high_a, low_b, high_b = x0, x0, ti.min(x2, x3), ti.max(x2, x3)
        if is_edges == 1:
            low_a, high_a = ti.min(low_a, x1), ti.max(high_a, x1)
        else:
            low_b, high_b = ti.min(low_b, x1), ti.max(high_b, x1)
        if meet(low_a - most, high_a + most, low_b, high_b):
            near = self.thickness + 2.0 * self.margin + steps * self.relative(self.foreseen, q, is_edges)
            o = self.closest(q, is_edges)
            d = o[0] * x0 + o[1] * x1 + o[2] * x2 + o[3] * x3
            if d.norm_sqr() < near * near:
                place = ti.atomic_add(self.counter[0], 1)
                if place < self.capacity:
                    self.pair[place], self.is_edges[place] = q, is_edges

    @ti.func
    def consider_triangles(self, a, b, most, steps):
        """A node and the triangles of a cell."""
        n = ti.static(self.n)
        if b // n < n - 1 and b % n < n - 1 and a != b and a != b + n + 1:
            if a != b + 1:
                self.consider(ivec4(a, b, b + 1, b + n + 1), 0, most, steps)
            if a != b + n:
                self.consider(ivec4(a, b, b + n + 1, b + n), 0, most, steps)

    @ti.func
    def edge_of(self, a, k):
        """Other end of the k-th edge of a cell, or -1."""
        n = ti.static(self.n)
        has_next, has_below = a % n < n - 1, a // n < n - 1
        end = -1
        if k == 0 and has_next:
            end = a + 1
        if k == 1 and has_below:
            end = a + n
        if k == 2 and has_next and has_below:
            end = a + n + 1
        return end

    @ti.func
    def consider_cells(self, a, b, steps):
        """Node, edges and triangles of two cells."""
        relative = (self.motion[a] - self.motion[b]).norm() + self.spread[a] + self.spread[b]
        most = self.thickness + 2.0 * self.margin + steps * relative
        if meet(self.low[a] - most, self.high[a] + most, self.low[b], self.high[b]):
            self.consider_triangles(a, b, most, steps)
            self.consider_triangles(b, a, most, steps)
            for k in range(3):
                e = self.edge_of(a, k)
                if e >= 0:
                    for m in range(3):
                        f = self.edge_of(b, m)
                        if f >= 0 and a != f and e != b and e != f:
                            self.consider(ivec4(a, e, b, f), 1, most, steps)

    @ti.kernel
    def search(self, steps: ti.f32, part: ti.f32) -> ti.i32:
        """List the pairs that may get within the thickness in so many substeps; returns how many there are.

        What nodes do in a substep is foreseen from their displacement in a part of one.
        """
        n, side, size = ti.static(self.n), ti.static(self.patches_a_side), ti.static(self.patch)
        wide = ti.static(0.5 * self.thickness + self.margin)
        for i in range(64):
            self.mean_sums[i] = 0
        for i in range(self.nodes):
            self.seen[i], self.foreseen[i] = self.x[i], self.u[i] / part
            for k in ti.static(range(3)):
                ti.atomic_add(self.mean_sums[i & 63][k], ti.cast(ti.round(self.foreseen[i][k] / self.quantum), ti.i64))
        for _ in range(1):
            total = ti.Vector.zero(ti.i64, 3)
            for k in range(64):
                total += self.mean_sums[k]
            self.mean[0] = ti.cast(total, ti.f32) * (self.quantum / self.nodes)
            self.counter[0], self.counter[1], self.counter[5] = 0, 0, 0
        for i in range(self.buckets):
            self.bucket_count[i] = 0
        for i in range(self.nodes):  # cells
            right, below = ti.select(i % n < n - 1, 1, 0), ti.select(i // n < n - 1, n, 0)
            corners = ivec4(i, i + right, i + below, i + right + below)
            low, high, mean = self.x[i], self.x[i], vec3(0)
            for k in ti.static(range(4)):
                low, high = ti.min(low, self.x[corners[k]]), ti.max(high, self.x[corners[k]])
                mean += 0.25 * self.foreseen[corners[k]]
            self.low[i], self.high[i], self.motion[i] = low, high, mean
            differs = 0.0
            for k in ti.static(range(4)):
                differs = ti.max(differs, (self.foreseen[corners[k]] - mean).norm_sqr())
                ends = self.x[corners[k]] + steps * (self.foreseen[corners[k]] - self.mean[0])
                low, high = ti.min(low, ends), ti.max(high, ends)
            self.spread[i] = ti.sqrt(differs)
            self.way_low[i], self.way_high[i] = low - wide, high + wide
            widest = 0.5 * (high - low).max() + wide
            ti.atomic_max(self.counter[5], ti.cast(ti.ceil(ti.min(widest / self.quantum, 2.0e9)), ti.i32))
            # Beyond the last row and column the cell before.
            j = i - ti.select(right == 0, 1, 0) - ti.select(below == 0, n, 0)
            now, later = self.normal_of(j, 0.0), self.normal_of(j, steps)
            self.normal[i] = ti.select(now.dot(later) > 0.95, now, 0.0)
        for i in range(self.nodes):  # bent: a cell within two rings is turned by 60 degrees or more
            bent = 0
            for r in range(ti.max(i // n - 2, 0), ti.min(i // n + 3, n)):
                for c in range(ti.max(i % n - 2, 0), ti.min(i % n + 3, n)):
                    if self.normal[i].dot(self.normal[r * n + c]) < 0.5:
                        bent = 1
            self.is_bent[i] = bent
        for q in range(self.patches):  # boxes of patches, cones of their normals
            low, high, axis, cosine = vec3(1e9), vec3(-1e9), vec3(0), 1.0
            for r in range(q // side * size, ti.min((q // side + 1) * size, n)):
                for c in range(q % side * size, ti.min((q % side + 1) * size, n)):
                    i = r * n + c
                    low, high = ti.min(low, self.way_low[i]), ti.max(high, self.way_high[i])
                    axis += self.normal[i]
            axis = axis / ti.max(axis.norm(), 1e-9)
            for r in range(q // side * size, ti.min((q // side + 1) * size, n)):
                for c in range(q % side * size, ti.min((q % side + 1) * size, n)):
                    cosine = ti.min(cosine, axis.dot(self.normal[r * n + c]))
            self.patch_low[q], self.patch_high[q], self.axis[q] = low, high, axis
            self.half_angle[q] = ti.acos(ti.math.clamp(cosine, -1.0, 1.0))
        for q in range(self.patches):
            flat = 1
            for r in range(ti.max(q // side - 1, 0), ti.min(q // side + 2, side)):
                for c in range(ti.max(q % side - 1, 0), ti.min(q % side + 2, side)):
                    o = r * side + c
                    turned = ti.acos(ti.math.clamp(self.axis[q].dot(self.axis[o]), -1.0, 1.0))
                    if turned + self.half_angle[q] + self.half_angle[o] > math.pi / 3:
                        flat = 0
            self.is_flat[q], self.near_count[q] = flat, 0
        for t in range(self.patches * self.lanes):
            q = t // self.lanes
            for j in range(self.patches // self.lanes + 1):
                o = j * self.lanes + t % self.lanes
                rings = ti.max(ti.abs(o // side - q // side), ti.abs(o % side - q % side))
                if o >= self.patches or rings < 2:
                    continue
                if meet(self.patch_low[o], self.patch_high[o], self.patch_low[q], self.patch_high[q]):
                    k = ti.atomic_add(self.near_count[q], 1)
                    if k < PATCH_PAIRS:
                        self.near[q, k] = o
        for i in range(self.nodes):  # cells that other parts of the sheet may come near to
            q = i // n // size * side + i % n // size
            active = ti.cast(self.is_flat[q] == 0 or self.near_count[q] > PATCH_PAIRS, ti.i32)
            if active == 0:
                for k in range(self.near_count[q]):
                    o = self.near[q, k]
                    if meet(self.patch_low[o], self.patch_high[o], self.way_low[i], self.way_high[i]):
                        active = 1
            self.is_active[i] = active
            if active == 1:
                bucket = self.bucket_of(self.cell_of(0.5 * (self.way_low[i] + self.way_high[i])))
                self.slot[i] = ti.atomic_add(self.bucket_count[bucket], 1)
        for b in range(self.buckets):
            if self.bucket_count[b] > 0:
                self.bucket_start[b] = ti.atomic_add(self.counter[1], self.bucket_count[b])
        for i in range(self.nodes):
            if self.is_active[i] == 1:
                bucket = self.bucket_of(self.cell_of(0.5 * (self.way_low[i] + self.way_high[i])))
                self.entry[self.bucket_start[bucket] + self.slot[i]] = i
        for a in range(self.nodes):  # neighbours in the sheet
            if self.is_bent[a] == 1:
                for dr in range(3):
                    for dc in range(ti.select(dr == 0, 1, -2), 3):
                        r, c = a // n + dr, a % n + dc
                        if r < n and c >= 0 and c < n:
                            self.consider_cells(a, r * n + c, steps)
        for a in range(self.nodes):  # all others
            if self.is_active[a] == 1:
                reach = self.quantum * self.counter[5]
                first, last = self.cell_of(self.way_low[a] - reach), self.cell_of(self.way_high[a] + reach)
                for i, j, k in ti.ndrange((first[0], last[0] + 1), (first[1], last[1] + 1), (first[2], last[2] + 1)):
                    cell = ti.Vector([i, j, k])
                    bucket = self.bucket_of(cell)
                    start = self.bucket_start[bucket]
                    for place in range(start, start + self.bucket_count[bucket]):
                        b = self.entry[place]
                        if b <= a or ti.max(ti.abs(b // n - a // n), ti.abs(b % n - a % n)) <= 2:
                            continue
                        low, high = self.way_low[b], self.way_high[b]
                        is_here = (self.cell_of(0.5 * (low + high)) == cell).all()
                        if is_here and meet(low, high, self.way_low[a], self.way_high[a]):
                            self.consider_cells(a, b, steps)
        return self.counter[0]

    @ti.func
    def normal_of(self, j, steps):
        """Of a cell after so many substeps; zero if it is squeezed then."""
        n = ti.static(self.n)
        p, q = self.x[j] + steps * self.foreseen[j], self.x[j + 1] + steps * self.foreseen[j + 1]
        r, s = self.x[j + n] + steps * self.foreseen[j + n], self.x[j + n + 1] + steps * self.foreseen[j + n + 1]
        least = ti.min((q - p).norm(), (r - p).norm(), (s - p).norm(), (r - q).norm())
        return ti.select(least > SQUEEZED * self.h, 1.0, 0.0) * (s - p).cross(r - q).normalized(1e-12)

    # --- contacts ---------------------------------------------------------------------------------------------------

    @ti.func
    def give(self, i, change):
        """Add to the corrections of a node."""
        q = ti.cast(ti.round(change / self.quantum), ti.i32)
        for k in ti.static(range(3)):
            ti.atomic_add(self.sums[i][k], q[k])
        ti.atomic_add(self.pushes[i], 1)

    @ti.func
    def take(self, i):
        """Make the mean correction of a node."""
        if self.pushes[i] > 0:
            self.u[i] += ti.cast(self.sums[i], ti.f32) * self.quantum / ti.cast(self.pushes[i], ti.f32)
            self.sums[i], self.pushes[i] = 0, 0

    @ti.kernel
    def touch(self, count: ti.i32):
        """Normals and distances of all pairs at the start of the substep."""
        for p in range(count):
            q = self.pair[p]
            self.weights[p] = self.closest(q, self.is_edges[p])
            d = self.between(p, q)
            length = ti.max(d.norm(), 1e-12)
            self.plane[p] = vec4(d.x / length, d.y / length, d.z / length, length)

    @ti.func
    def correct(self, p):
        """Push what is too near, or gets there, with friction."""
        q, k, n, start = self.pair[p], self.weights[p], self.plane[p].xyz, self.plane[p].w
        relative = k[0] * self.u[q[0]] + k[1] * self.u[q[1]] + k[2] * self.u[q[2]] + k[3] * self.u[q[3]]
        wanted = self.thickness
        if start < wanted:
            wanted = start + ti.min(1.0, self.dt[None] / RECOVERY_TIME_S) * (wanted - start)
            if start < NEAR * self.h:
                wanted = ti.max(wanted, start + RATE * (NEAR * self.h - start))
        missing = wanted - start - relative.dot(n)
        if missing > 0:
            weight = 0.0
            for m in ti.static(range(4)):
                weight += self.w[q[m]] * k[m] * k[m]
            if weight > 0:
                slip = relative - relative.dot(n) * n
                length = slip.norm()
                push = missing / weight * n
                if length > 0:
                    push -= slip / length * ti.min(FRICTION * missing, length) / weight
                for m in ti.static(range(4)):
                    self.give(q[m], self.w[q[m]] * k[m] * push)
                ti.atomic_add(self.counter[3], 1)

    @ti.func
    def shorten(self, i, j):
        """Pull the ends of a spring together that is beyond its limit."""
        d = self.x[j] + self.u[j] - self.x[i] - self.u[i]
        length, weight = d.norm(), self.w[i] + self.w[j]
        beyond = length - (1.0 + STRAIN_LIMIT) * self.h
        if beyond > 0 and weight > 0:
            self.give(i, self.w[i] * beyond / (weight * length) * d)
            self.give(j, -self.w[j] * beyond / (weight * length) * d)

    @ti.kernel
    def push(self, count: ti.i32, age: ti.f32) -> ti.types.vector(2, ti.i32):
        """Two iterations of contacts and limits; returns contacts, and how far nodes stray from where they were
        foreseen, in `quantum`."""
        n = ti.static(self.n)
        for i in range(self.nodes):
            self.keep_out(i)
            if i == 0:
                self.counter[3] = 0
        for _ in ti.static(range(2)):
            for p in range(count):
                self.correct(p)
            for i in range(self.nodes):
                if i % n < n - 1:
                    self.shorten(i, i + 1)
                if i // n < n - 1:
                    self.shorten(i, i + n)
            for i in range(self.nodes):
                self.take(i)
                self.keep_out(i)
        self.look_where_nodes_are(age)
        self.conclude()
        return ti.Vector([self.counter[3], self.counter[6]])

    @ti.kernel
    def push_again(self, count: ti.i32):
        """What `test` gave, then an iteration of contacts."""
        for i in range(self.nodes):
            self.take(i)
            self.keep_out(i)
        for p in range(count):
            self.correct(p)
        for i in range(self.nodes):
            self.take(i)

    @ti.func
    def look_where_nodes_are(self, age):
        for i in range(self.nodes):
            off = (self.x[i] - self.seen[i] + self.u[i] - age * self.foreseen[i]).norm()
            strayed = ti.cast(ti.min(off / self.quantum, 2.0e9), ti.i32)
            if strayed > self.strayed[i & 63]:
                ti.atomic_max(self.strayed[i & 63], strayed)

    @ti.func
    def look_how_long_springs_are(self):
        n = ti.static(self.n)
        for i in range(self.nodes):
            p, length = self.x[i] + self.u[i], 0.0
            if i % n < n - 1:
                length = (self.x[i + 1] + self.u[i + 1] - p).norm()
            if i // n < n - 1:
                length = ti.max(length, (self.x[i + n] + self.u[i + n] - p).norm())
            strain = ti.cast(1e6 * ti.min(length / self.h - 1.0, 1e3), ti.i32)
            if strain > self.strains[i & 63]:
                ti.atomic_max(self.strains[i & 63], strain)

    @ti.func
    def conclude(self):
        """Most of what was looked at, in one thread: a loop that is not within another runs in parallel on a GPU."""
        for _ in range(1):
            strayed, strain = 0, 0
            for k in range(64):
                strayed, strain = ti.max(strayed, self.strayed[k]), ti.max(strain, self.strains[k])
                self.strayed[k], self.strains[k] = 0, 0
            self.counter[6], self.counter[7] = strayed, strain

    @ti.func
    def gap(self, p):
        """How far both sides are apart at the end, along the normal; and the nodes that are nearest the other side."""
        q, n = self.pair[p], self.plane[p].xyz
        y = vec4(0)
        for k in ti.static(range(4)):
            y[k] = n.dot((self.x[q[k]] - self.x[q[0]]) + self.u[q[k]])
        low, a, high, b = y[0], q[0], y[3], q[3]
        if y[2] > high:
            high, b = y[2], q[2]
        if self.is_edges[p] == 1 and y[1] < low:
            low, a = y[1], q[1]
        if self.is_edges[p] == 0 and y[1] > high:
            high, b = y[1], q[1]
        return low - high, a, b

    @ti.func
    def may_cross(self, p, gap):
        """Whether the gap is less than contacts keep, or it was at the start, and the pair does not move as one."""
        q, start = self.pair[p], self.plane[p].w
        moved = self.relative(self.u, q, self.is_edges[p])
        return gap < ti.min(self.least_gap, start - 1e-3 * self.least_gap) and moved > 1e-2 * start

    @ti.kernel
    def test(self, count: ti.i32, age: ti.f32, gives: ti.i32) -> ti.types.vector(3, ti.i32):
        """How many pairs may cross, which get corrections if `gives`; how far nodes stray; the worst strain."""
        for _ in range(1):
            self.counter[2] = 0
        for p in range(count):
            gap, a, b = self.gap(p)
            if self.may_cross(p, gap):
                ti.atomic_add(self.counter[2], 1)
                weight = self.w[a] + self.w[b]
                if gives == 1 and weight > 0:
                    n, start = self.plane[p].xyz, self.plane[p].w
                    missing = (ti.min(2.0 * self.least_gap, start) - gap) / weight
                    self.give(a, self.w[a] * missing * n)
                    self.give(b, -self.w[b] * missing * n)
        self.look_where_nodes_are(age)
        self.look_how_long_springs_are()
        self.conclude()
        return ti.Vector([self.counter[2], self.counter[6], self.counter[7]])

    # --- zones ------------------------------------------------------------------------------------------------------

    @ti.kernel
    def join(self, count: ti.i32) -> ti.i32:
        """Join the zones of pairs that may cross, a step; returns whether there is more to do."""
        for _ in range(1):
            self.counter[4] = 0
        for p in range(count):
            if self.may_cross(p, self.gap(p)[0]):
                q = self.pair[p]
                least = ti.min(self.zone[q[0]], self.zone[q[1]], self.zone[q[2]], self.zone[q[3]])
                for k in ti.static(range(4)):
                    if self.zone[q[k]] > least:
                        ti.atomic_min(self.zone[self.zone[q[k]]], least)
                        ti.atomic_min(self.zone[q[k]], least)
                        self.counter[4] = 1
        for i in range(self.nodes):
            least = self.zone[i]
            while self.zone[least] < least:
                least = self.zone[least]
            if least < self.zone[i]:
                self.zone[i] = least
                self.counter[4] = 1
        return self.counter[4]

    @ti.kernel
    def move_zones(self):
        """Nodes of a zone move by its mean displacement, or as the one that is held."""
        for i in range(self.nodes):
            self.zone_sum[i], self.zone_count[i], self.zone_held[i] = 0, 0, -1
        for i in range(self.nodes):
            zone = self.zone[i]
            if self.w[i] == 0:
                ti.atomic_max(self.zone_held[zone], i)
            for k in ti.static(range(3)):
                ti.atomic_add(self.zone_sum[zone][k], ti.cast(ti.round(self.u[i][k] / self.quantum), ti.i64))
            ti.atomic_add(self.zone_count[zone], 1)
        for i in range(self.nodes):
            zone = self.zone[i]
            if self.zone_count[zone] > 1 and self.w[i] > 0:
                if self.zone_held[zone] >= 0:
                    self.u[i] = self.u[self.zone_held[zone]]
                else:
                    self.u[i] = ti.cast(self.zone_sum[zone], ti.f32) * self.quantum / self.zone_count[zone]


@ti.func
def meet(low_a, high_a, low_b, high_b):
    """Whether two boxes do."""
    return (low_a <= high_b).all() and (low_b <= high_a).all()
