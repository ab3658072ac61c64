"""Bundles of arrays that the kernels of cloth take (`sim.core.bundles`), and the types of these arrays.

n nodes, k triangles, m patches, p pairs of patches, c contacts, b bodies, w walls.
"""

from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Floats, Integers, LongIntegers, Matrices, Vectors
from sim.core.bundles import bundle
from sim.shapes.device_shapes import Shapes

Two = ti.types.vector(2, ti.i32)
Three = ti.types.vector(3, ti.i32)
Four = ti.types.vector(4, ti.i32)
Lattice = ti.types.ndarray(dtype=ti.math.ivec3, ndim=1)
Laws = ti.types.ndarray(dtype=ti.math.vec3, ndim=1)
Pairs = ti.types.ndarray(dtype=Two, ndim=1)
Triples = ti.types.ndarray(dtype=Three, ndim=1)
Quadruples = ti.types.ndarray(dtype=Four, ndim=1)
Weights = ti.types.ndarray(dtype=ti.math.vec4, ndim=1)
Strains = ti.types.ndarray(dtype=ti.math.vec2, ndim=1)
Planes = ti.types.ndarray(dtype=ti.math.vec4, ndim=1)


# --- nodes, springs, air; fields as the attributes of `ClothState`, `DeviceSprings` and `ClothAir` ------------------


@bundle
class Nodes(NamedTuple):
    """Nodes as springs displace them."""

    lattice: Lattice  # where the substep starts, in quanta, (n,)
    quantum: ti.f32  # [m]
    inverse_mass: Floats  # [1/kg], (n,); 0 where a node is pinned
    displacement: Vectors  # from the lattice's position to the end of the substep, `carry` included [m], (n,)
    carry: Vectors  # what the lattice lacks [m], (n,), at most half a quantum
    velocity: Vectors  # at the start of the substep [m/s], (n,)


@bundle
class Surface(NamedTuple):
    """Nodes as contacts are looked for."""

    position: Vectors  # where the substep starts, rounded to float32 [m], (n,)
    displacement: Vectors  # [m], (n,)
    thickness: Floats  # distance that layers keep [m], (n,)
    friction: Floats  # Coulomb's coefficient [-], (n,)


@bundle
class SpringArrays(NamedTuple):
    """Springs of one family; a piece is one spring where they are solved one by one."""

    count: ti.i32  # s
    nodes: Integers  # (arity s,)
    law: Laws  # rest length [m], stiffness [N/m], damping over stiffness [s], (s,)
    coefficients: Floats  # of springs with four nodes, (4 s,)
    shift: Floats  # what springs of threads count as longer, because of the strain across [m], (s,)
    segment_start: Integers  # first spring of each piece, and number of springs, (pieces + 1,)


@bundle
class MeshNodes(NamedTuple):
    """Nodes of s triangles, piece by piece, in chunks of about as many nodes as there are chunks."""

    count: ti.i32  # o
    chunks: ti.i32
    pieces: ti.i32
    node: Integers  # number, (o,)
    start: Integers  # of each node in `corner`, (o + 1,)
    corner: Integers  # corner a of triangle s is 3 s + a
    share: Floats  # of each corner's triangle in the strain of its node, (3 s,)
    swapped: Integers  # as of `Cells`, (3 s,)
    strain: Strains  # e_u and e_v of triangles, (s,)
    mean: Strains  # of nodes, (n,)
    piece: Integers  # (o,)
    chunk: Integers  # first node of each chunk, and o
    first_chunk: Integers  # of each piece, and number of chunks


@bundle
class CellArrays(NamedTuple):
    """Cells with as many nodes each."""

    count: ti.i32  # s
    nodes: Integers  # (arity s,)
    along: Floats  # c_a of d_u [1/m], (arity s,)
    across: Floats  # c_a of d_v [1/m], (arity s,)
    law: Weights  # area times C and G [J], nu [-], damping over stiffness [s], (s,)
    multiplier: Floats  # of the shear, (s,); rectangles only
    followed: Strains  # shear where the last step started [-], and its smoothed rate [1/s], (s,); triangles: (3 s,)
    mesh: MeshNodes  # those of triangles; none of rectangles


@bundle
class TriangleFrames(NamedTuple):
    """Along which triangles push in a step, and by how much, (s,) each."""

    n_u: Vectors  # direction of the warp
    n_v: Vectors
    by_u: Vectors  # derivatives of the shear
    by_v: Vectors
    turning: Weights  # tension over length that turns with warp, weft, their sum and difference [J]
    s_u: Vectors  # forces along d_u and d_v [J]
    s_v: Vectors
    start: Strains  # e_u and e_v at the start of the step


@bundle
class TriangleWork(NamedTuple):
    """Numbers of conjugate gradients, (n,) each."""

    start_mean: Strains  # e_u and e_v at the start of the step
    x: Vectors  # solution [m]
    r: Vectors  # residual [kg m]
    z: Vectors  # preconditioned residual [m]
    a_z: Vectors  # matrix times that [kg m]
    p: Vectors  # direction of the search [m]
    q: Vectors  # matrix times that [kg m]
    diagonal: Vectors  # of the inverse blocks [1/kg]
    off_diagonal: Vectors  # their yz, xz and xy
    scalars: Floats  # decrease by the start, then gamma and alpha of each iteration
    moment: Weights  # of each chunk [kg m], and mass [kg]
    shift: Vectors  # of each piece [m]


@bundle
class TriangleSystem(NamedTuple):
    """What triangles are solved by together."""

    cells: CellArrays
    frames: TriangleFrames
    work: TriangleWork


@bundle
class Contraction(NamedTuple):
    """How springs of threads feel the strain across."""

    axis: Integers  # along which a spring runs, (s,)
    poisson: Floats  # ratio, (s,)
    share: Floats  # of each spring in the strain of a node, along both axes, (2 n,)
    strain: Floats  # of nodes along both axes, (2 n,)


@bundle
class ThreadWork(NamedTuple):
    """Numbers of each spring of threads within a substep, (s,) each."""

    multiplier: Floats
    tension: Floats  # too much of it, over the length
    direction: Vectors  # along which it pushes; on a CPU, as what follows
    change: Floats  # of the multiplier, as far as known
    factor: Floats  # of the change of the spring before
    is_taut: Integers  # whether a piece has tension to straighten, (pieces,)


@bundle
class Air(NamedTuple):
    """Air at the triangles."""

    velocity: Vectors  # [m/s], (k,)
    inverse_mass: Floats  # area of cloth over mass of the air that it acts on [m²/kg], (k,); 0 for wind
    drag: Vectors  # rho C_n / 2, rho C_t / 2 [kg/m³], mass of the triangle [kg], (k,)
    force: Vectors  # on each triangle in the last substep [N], (k,)
    impulse: Vectors  # since a coupling set it to zero [N s], (k,)
    share: Floats  # of each node in the force on any of its triangles [-], (n,)
    triangle_start: Integers  # of each node in the list, which has triangles in ascending order, (n + 1,)
    triangle_list: Integers
    triangles: Triples  # their nodes, (k,)


# --- patches --------------------------------------------------------------------------------------------------------


@bundle
class PatchNodes(NamedTuple):
    """Nodes in lists, one of each patch."""

    count: ti.i32  # of the patches
    first: Integers  # place of each patch's first node, and number of places, (m + 1,)
    nodes: Integers


@bundle
class PatchLists(NamedTuple):
    """What of the cloth each patch has, in lists: its own nodes, its edges and triangles."""

    vertices: PatchNodes
    first_edge: Integers  # (m + 1,)
    edges: Pairs
    first_triangle: Integers  # (m + 1,)
    triangles: Triples


@bundle
class PatchMotion(NamedTuple):
    """Rigid motion of each patch in the substep, which its displacements are near."""

    centre: Vectors  # [m], (m,)
    shift: Vectors  # [m], (m,)
    turn: Vectors  # [rad], (m,)
    radius: Floats  # largest distance of a corner from the centre [m], (m,)
    rest: Floats  # largest difference of a displacement from that motion [m], (m,)


@bundle
class Boxes(NamedTuple):
    """Boxes of the patches at the start of the substep."""

    low: Vectors  # [m], (m,)
    high: Vectors


@bundle
class MovingPatches(NamedTuple):
    """Patches as their motion is followed: where they are, and distances that they move and that lists allow for [m],
    (m,) each."""

    corners: PatchNodes  # all nodes of their triangles
    boxes: Boxes
    motion: PatchMotion
    moves: Floats  # largest distance of a vertex from the middle of all displacements
    change: Floats  # largest displacement by contacts
    margin: Floats  # how far contacts may displace
    more: Floats  # what of the margin is beyond half a thickness
    spent: Floats  # sum over the substeps since the patches were paired
    travel: Floats  # `spent`, with this substep and `more`
    reach: Floats  # which `travel` may have until they are paired anew


@bundle
class BoxTree(NamedTuple):
    """Boxes of a complete binary tree: 2 i and 2 i + 1 are below node i, 1 is the root."""

    leaves: ti.i32  # leaf k is node `leaves` + k
    low: Vectors  # [m], (2 leaves,)
    high: Vectors


@bundle
class KnownPairs(NamedTuple):
    """Pairs of patches of whose elements something is known, by their first patch."""

    first: Integers  # those of patch i are known[first[2 i]:first[2 i + 1]], (2 m,)
    known: Integers  # numbers of pairs
    pairs: Pairs
    slack: Floats


@bundle
class PatchPairArrays(NamedTuple):
    """Pairs of patches, (p,) each."""

    count: ti.i32  # p
    pairs: Pairs  # numbers of the patches, the smaller first
    slack: Floats  # how much nearer elements may come that are not listed [m]
    wake: Floats  # what the patches of a sleeping pair spend until it wakes [m], or -1
    left: Floats  # how much of `slack` those that are listed may use up until they are due [m]
    approach: Floats  # how much nearer points come at most in this substep [m]
    allowed: Floats  # how much contacts may add to that [m]
    reach: Floats  # how far to search for elements [m]
    due: Integers  # numbers of the pairs of which elements have to be looked at
    expired: Integers  # numbers of those that have to be searched
    needed: Integers  # 1 for their patches, (m,)
    taken: Integers  # items of each loop; see `sim.core.scheduling`
    found: Integers  # what threads count together


@bundle
class Followed(NamedTuple):
    """Nodes, patches and their pairs from substep to substep."""

    position: Vectors  # of nodes [m], (n,)
    displacement: Vectors  # [m], (n,)
    expected: Vectors  # where the substep before should have led [m], (n,)
    patches: MovingPatches
    met: PatchPairArrays
    thickness: ti.f32  # the largest [m]
    astray: ti.f32  # largest distance of a vertex from where the substep before should have led it [m]


# --- pairs of elements ----------------------------------------------------------------------------------------------


@bundle
class PairPieces(NamedTuple):
    """Listed pairs of elements, in two pieces of each of p pairs of patches: vertices with triangles, and edges."""

    pieces: Quadruples  # first place, places, and how many of them are taken, (2 p,)
    piece_due: Floats  # the largest `due` of each piece [m], `NEVER` where nothing is listed, (2 p,)
    again: Integers  # numbers of the pieces that were too short, and are searched again, (2 p,)
    ends: Integers  # of all pieces; and how many are searched again, (2,)
    pairs: Quadruples  # a vertex and a triangle's corners, or the ends of two edges
    wanted: Floats  # distance that they keep [m]; `UNKNOWN` until they have come so near that it matters
    due: Floats  # they are looked at when `PatchPairArrays.left` is not above it [m]


@bundle
class EdgeBlocks(NamedTuple):
    """Edges of patches in blocks; see `self_collision.blocks_of`."""

    first_block: Integers  # of each patch, (m + 1,)
    edges: Pairs
    mid_x: Floats  # of the midpoints [m]
    mid_y: Floats
    mid_z: Floats
    half_x: Floats  # half the vectors along them [m]
    half_y: Floats
    half_z: Floats


@bundle
class TriangleBlocks(NamedTuple):
    """Triangles of patches in blocks; see `self_collision.blocks_of`."""

    first_block: Integers  # of each patch, (m + 1,)
    triangles: Triples
    low_x: Floats  # of the boxes [m]
    low_y: Floats
    low_z: Floats
    high_x: Floats
    high_y: Floats
    high_z: Floats


@bundle
class PatchBlocks(NamedTuple):
    """Elements of patches as they are searched."""

    vertices: PatchNodes
    triangles: TriangleBlocks
    edges: EdgeBlocks


# --- contacts -------------------------------------------------------------------------------------------------------


@bundle
class Contacts(NamedTuple):
    """Contacts as they are found, (c,) each; see `ContactList`."""

    vertices: Quadruples  # up to four; of a vertex and a triangle in this order, of two edges in turn
    weights: Weights  # signed; 0 of vertices that do not count
    normal: Vectors  # unit vector from the second to the first, or out of the body
    floor: Floats  # least relative displacement along the normal [m], or `INACTIVE`
    kind: Integers  # `VERTEX_TRIANGLE`, `EDGE_EDGE`, `WALL`, or the number of a body
    arm: Vectors  # from the body's centre of mass to the point [m]; then, if it `drifts`, how the surface does [m]
    drifts: ti.template()  # whether any body deforms
    friction: Floats  # Coulomb's coefficient [-]
    counter: Integers  # (4,)
    capacity: ti.i32


@bundle
class PairSearch(NamedTuple):
    """What pairs of elements are listed and looked at with."""

    met: PatchPairArrays
    boxes: Boxes
    blocks: PatchBlocks
    listed: PairPieces
    surface: Surface
    cloth: Integers  # of nodes, (n,)
    at_rest: Vectors  # where nodes start [m], (n,)
    recovery: ti.f32  # share of a missing distance that the substep gives back [-]
    contacts: Contacts  # which pairs that meet are appended to


@bundle
class TestedContacts(NamedTuple):
    """What the test of contacts for crossings reads and writes besides; see `repair_crossing`."""

    impulse: Vectors  # [kg m], (c,)
    inverse_mass: Floats  # [1/kg], (n,)
    thickness: Floats  # [m], (n,)
    crossing: Integers  # (c,)


@bundle
class Impulses(NamedTuple):
    """Impulses of contacts, (c,) each."""

    mobility: Floats  # what w grows by per impulse, all contacts pushing alike [1/kg]
    impulse: Vectors  # on the first, minus that on the second, times the step [kg m]
    impulse_before: Vectors  # an iteration earlier
    impulse_given: Vectors  # that displacements contain already
    pushing: Integers  # numbers of the contacts that push
    push: Vectors  # what they give in a step of the iteration, in units, in the same order
    used_by: Integers  # places of contacts in that order, node by node, (4 c,)
    use_weight: Floats  # their weights, (4 c,)
    unit: ti.f32  # of sums of impulses [kg m]


@bundle
class PushedNodes(NamedTuple):
    """Nodes as contacts push them, and what is found of each as contacts are weighed."""

    displacement: Vectors  # [m], (n,)
    inverse_mass: Floats  # [1/kg], (n,)
    start: Vectors  # displacement where the iteration starts [m], (n,)
    reached: Vectors  # displacement without momentum [m], (n,)
    touched: Integers  # numbers of those that contacts push
    uses: Integers  # first and last place of each node in `Impulses.used_by`, (2 n,)
    support: Vectors  # see `contact_response`, (n,)
    counter: Integers  # contacts that push, their nodes, and uses; whether any misses much, is settled, (5,)
    predicted: Vectors  # displacement as contacts were looked for [m], (n,)
    shares: Integers  # sum of weights, in 1 / `SHARES_PER_UNIT`, (n,)
    held_sums: Integers  # of normals of what stands, then of what presses, (6 n,)
    lever: Floats  # square root of the largest mobility of a body that presses [kg^(-1/2)], (n,)
    pressing_body: Integers  # its number, or -1, (n,)
    between: Integers  # whether what stands and what presses touch it, `STANDS` and `PRESSED`, (n,)


@bundle
class PushedBodies(NamedTuple):
    """Bodies as contacts push them, (b,) each."""

    may_move: ti.i32  # whether forces move any of them, or ever did
    count: ti.i32  # b
    motion: Vectors  # displacement of the centre of mass [m] and rotation vector [rad] of each in turn, (2 b,)
    motion_start: Vectors  # at the start of an iteration
    motion_reached: Vectors  # in its course
    inverse_mass: Floats  # [1/kg]; 0 for all that no force moves
    inverse_inertia: Matrices  # in world axes [1/(kg m²)]
    gathered: LongIntegers  # linear and angular impulse times the step, in units, (6 b,)
    impulse: LongIntegers
    load: LongIntegers  # sums over the contacts of a body and of all that it leads, in `load_unit`s
    load_unit: ti.f32  # [kg^(-1/2)]
    glued: ti.template()  # whether some move as one; else what follows means nothing
    leader: Integers  # the first of those that move as one; its own number if it is alone
    next: Integers  # the next of those, or -1
    arm: Vectors  # from the centre of mass of all of them to its own [m]


@bundle
class Response(NamedTuple):
    """Contacts, and what they push."""

    contacts: Contacts
    impulses: Impulses
    nodes: PushedNodes
    bodies: PushedBodies


@bundle
class CollidingBodies(NamedTuple):
    """Bodies as cloth looks for them, (b,) each."""

    count: ti.i32  # b
    shapes: Shapes
    shows: Integers  # whether it may show between vertices, so that triangles are looked at; 2 if edges are, too
    depth: Floats  # how deep free cloth was in it at most since the frame began, in thicknesses
    centre_of_mass: Vectors  # [m]
    radius: Floats  # [m]
    step: Floats  # [m]
    friction: Floats  # [-]
    passes: Integers  # 1 where cloth c passes through body b by a joint, at c times their number + b
    lift: Floats  # how much farther than half a thickness vertices keep [m]
    position: Vectors  # centre of mass at the start of the substep [m]
    rotation: Matrices  # body axes to world axes
    motion: Vectors  # as of `PushedBodies`


@bundle
class Walls(NamedTuple):
    """Closed faces of the domain, (w,) each."""

    count: ti.i32  # w
    spacing: ti.f32  # mean edge of the coarsest cloth [m]
    plane: Planes  # normal into the domain, and its product with a point of the wall [m]
    low: Vectors  # corners of the wall [m], infinite across it
    high: Vectors
    joined_low: Vectors  # 1 on axes on which another wall joins it, else 0
    joined_high: Vectors


@bundle
class Touching(NamedTuple):
    """Cloth, and what it may touch besides itself."""

    surface: Surface
    inverse_mass: Floats  # of nodes [1/kg], (n,)
    cloth: Integers  # of nodes, (n,)
    walls: Walls
    bodies: CollidingBodies
    recovery: ti.f32  # share of a missing distance that the substep gives back [-]
    contacts: Contacts  # which what touches is appended to
