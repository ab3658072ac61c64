"""About how much work the loops of cloth are, by which short ones are told (`sim.core.scheduling`)."""

NODE_NS, NODE_IN_ROWS_NS, NODE_IN_AIR_NS, COPIED_NODE_NS = 14.0, 12.0, 54.0, 4.0
"""Work a node [ns]: in sums and maxima over nodes, in one loop of springs in rows, in air, in copies and tests;
roughly, as are those below, from processor times at 128 x 128 nodes."""

CONTACT_NS = 25.0
"""Work of one step of the iteration a contact [ns]."""

TRIANGLE_NS, NODE_OF_MESH_NS = 40.0, 60.0
"""Work of one iteration of conjugate gradients a triangle, and a node [ns]."""
