"""Loops of a CPU that the thread which launches them has done before others wake.

To give a loop to threads and wait for them costs 40 to 70 us on two cores that otherwise sleep, with one thread too,
and the second one wakes later still; to run it where it is launched costs nothing (`benchmarks.kernel_costs`). So
short loops are left serial. Which ones are depends on the device and on sizes (of cloth also on the number of contacts,
watched ones included), but never on the number of threads: compiled either way, a loop may differ in its last bits. Nor
may it depend on when lists were made, as results do not: contacts are the same whatever the lists, and each loop over
pairs of patches or elements is compiled one way on a device, whatever their number. On a GPU no loop is short: a serial
one would have one thread.
"""

from sim.reductions import runs_on_gpu

LONGEST_NS = 250_000.0
"""Work of a loop up to which two threads should gain nothing, by what waking both costs: an estimate [ns]. With many
more threads the longest of these loops would be done sooner in parallel."""


def is_short(items: int, item_ns: float) -> bool:
    """Whether a loop over so many items, of about so much work each [ns], is better left to one thread."""
    return not runs_on_gpu() and bool(items * item_ns <= LONGEST_NS)
