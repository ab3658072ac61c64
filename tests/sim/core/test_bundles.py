"""Bundles of arrays and numbers as arguments of kernels."""

from typing import NamedTuple

import numpy as np
import pytest
import taichi as ti

from sim.core.arrays import Floats, Vectors
from sim.core.bundles import bundle, func, with_room
from sim.core.launch import kernel


@bundle
class Step(NamedTuple):
    dt: ti.f32
    gravity: ti.math.vec3


@bundle
class Particles(NamedTuple):
    x: Vectors
    v: Vectors
    m: Floats


@bundle
class Fall(NamedTuple):
    particles: Particles
    step: Step


@func
def kick(fall: Fall, i: ti.i32):
    fall.particles.v[i] += fall.step.dt * fall.step.gravity * fall.particles.m[i]


@kernel
def fall_in_bundles(fall: Fall, count: ti.i32, doubled: ti.template()):
    for i in range(count):
        kick(fall, i)
        fall.particles.x[i] += fall.step.dt * fall.particles.v[i]
        if ti.static(doubled):
            fall.particles.x[i] *= 2.0


@kernel
def fall_one_by_one(x: Vectors, v: Vectors, m: Floats, dt: ti.f32, gravity: ti.math.vec3, count: ti.i32):
    for i in range(count):
        v[i] += dt * gravity * m[i]
        x[i] += dt * v[i]


@kernel
def ask_for_a_field_that_is_not_there(fall: Fall):
    for i in range(1):
        fall.particles.x[i] = fall.particles.momentum[i]


@kernel
def total_mass(particles: Particles, count: ti.i32) -> ti.f32:
    total = 0.0
    ti.loop_config(serialize=True)
    for i in range(count):
        total += particles.m[i]
    return total


def particles(count: int) -> Particles:
    x, v = (ti.Vector.ndarray(3, ti.f32, count) for _ in range(2))
    m = ti.ndarray(ti.f32, count)
    x.from_numpy(np.random.default_rng(1).random((count, 3), np.float32))
    m.from_numpy(np.linspace(0.5, 1.5, count, dtype=np.float32))
    return Particles(x, v, m)


GRAVITY = ti.math.vec3(0.0, 0.3, -9.81)


def test_a_bundle_computes_the_same_bits_as_its_fields_one_by_one(taichi_cpu):
    bundled, single = particles(100), particles(100)
    for dt in (0.01, 0.02):
        fall_in_bundles(Fall(bundled, Step(dt, GRAVITY)), 100, False)
        fall_one_by_one(*single, dt, GRAVITY, 100)
    assert np.array_equal(bundled.x.to_numpy(), single.x.to_numpy())
    assert np.any(bundled.v.to_numpy())


def test_compile_time_values_stand_beside_bundles(taichi_cpu):
    bundled, single = particles(10), particles(10)
    fall_in_bundles(Fall(bundled, Step(0.01, GRAVITY)), 10, True)
    fall_one_by_one(*single, 0.01, GRAVITY, 10)
    assert np.array_equal(bundled.x.to_numpy(), 2.0 * single.x.to_numpy())


def test_other_arrays_in_a_bundle_are_other_arrays_in_the_kernel(taichi_cpu):
    light, heavy = particles(10), particles(10)
    heavy.m.fill(5.0)
    assert [total_mass(p, 10) for p in (light, heavy, light)] == pytest.approx([10.0, 50.0, 10.0])


def test_a_field_that_a_bundle_lacks_is_named(taichi_cpu):
    with pytest.raises(Exception, match=r"fall\.particles has no field momentum"):
        ask_for_a_field_that_is_not_there(Fall(particles(1), Step(0.01, GRAVITY)))


def test_a_bundle_of_another_type_is_refused(taichi_cpu):
    with pytest.raises(TypeError, match="total_mass takes a Particles, got a Step"):
        total_mass(Step(0.01, GRAVITY), 1)


@bundle
class Both(NamedTuple):
    first: Floats
    second: Floats


@kernel
def copy_one(both: Both, of_second: ti.template(), out: Floats):
    for i in range(out.shape[0]):
        if ti.static(of_second):
            out[i] = both.second[i]
        else:
            out[i] = both.first[i]


def test_fields_that_a_kernel_does_not_read_are_passed_to_none_of_its_launches(taichi_cpu):
    def filled(value: float) -> ti.Ndarray:
        array = ti.ndarray(ti.f32, 4)
        array.fill(value)
        return array

    first, second, out = filled(1.0), filled(2.0), filled(0.0)
    for _ in range(2):
        copy_one(Both(first, second), False, out)
        np.testing.assert_array_equal(out.to_numpy(), 1.0)
    copy_one(Both(first, filled(3.0)), False, out)  # another array where none is read
    assert len(copy_one._launches) == 1
    # Compiled to read the other field, it is passed both from now on.
    for _ in range(2):
        copy_one(Both(first, second), True, out)
        np.testing.assert_array_equal(out.to_numpy(), 2.0)
        copy_one(Both(second, first), False, out)
        np.testing.assert_array_equal(out.to_numpy(), 2.0)


@pytest.mark.usefixtures("taichi_cpu")
def test_a_bundle_makes_arrays_of_its_types_but_for_what_it_is_given():
    v = ti.Vector.ndarray(3, ti.f32, 7)
    particles = with_room(Particles, 5, v=v)
    assert particles.v is v
    assert particles.x.to_numpy().shape == (5, 3)
    assert particles.m.to_numpy().tolist() == 5 * [0.0]
    assert with_room(Particles, 0).m.shape == (1,)  # kernels need one
