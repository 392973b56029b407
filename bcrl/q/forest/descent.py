"""Compiled prediction: rows go down the trees of a grown forest.

Many rows are sorted down a tree together; few rows walk down some trees side by side, a
level at a time, so that the processor overlaps their reads. Neither way branches on a
row's side, and both add a row's values in the order of the trees: the same bytes.
"""

from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.core.cgutils import get_or_insert_function
from numpy.typing import NDArray

from bcrl.common.compiling import compiled, instructions, kept
from bcrl.q.forest.groups import GROUP, SHUFFLE, sift
from bcrl.q.forest.split import LOW32, NODE, U, inlined, key_of, uncounted

#: So many rows, and one more for SHARE nodes of a tree, are sorted faster than walked.
TOGETHER, SHARE = 32, 50
WALKERS = 128  # at least so many, if there are enough trees, hide that memory is slow
LINE, AHEAD = 5, 4096  # nodes in a cache line; nodes that are read ahead: 48 KiB
HIGH = U(32)  # where a walker's number begins in its word
CACHED = 2**20  # keys of the rows that are sorted together: 4 MiB


class Descent(NamedTuple):
    """The rows (m, d) that go down, and memory for their way.

    A row is named by the place where its keys begin: a product less in each node. A
    row's room is a power of two, and its number a shift away: a division less. Rows lie
    in three planes, like those that a tree grows from.
    """

    keys: NDArray[np.int32]  # (m · 2^shift,), fewer than 2^32
    shift: np.uint64  # the least with d <= 2^shift
    rows: NDArray[np.uint32]  # (3 m + GROUP,)
    words: NDArray[np.int64]  # the same of the keys, if groups move; else empty
    stack: NDArray[np.int64]


@compiled()
def new_descent(x):
    """The descent of x (m, d) float32."""
    m, d = x.shape
    shift = U(np.ceil(np.log2(d)))
    keys = np.empty(U(m) << shift, np.int32)
    for i in range(U(m)):
        for f in range(d):
            keys[(i << shift) + U(f)] = key_of(x[i, f])
    room, moved = 3 * m + GROUP, SHUFFLE and d == 2
    rows, words = np.empty(room, np.uint32), np.empty(room if moved else 0, np.int64)
    for i in range(U(m)):
        rows[i] = np.uint32(i << shift)
    if moved:
        words[:m] = keys.view(np.int64)
    stack = np.empty((m + 1, 4), np.int64)  # memory that is not used is free
    return Descent(keys, shift, rows, words, stack)


@inlined
def plane(depth):
    """The plane that a node of this depth lies in."""
    return U(0) if depth == 0 else U(1 + (depth & 1))


@inlined
def sort_node(descent, m, depth, start, stop, feature, cut):
    """Sort a node's rows into its children's plane; returns the left child's end."""
    keys, rows, words, column = descent.keys, descent.rows, descent.words, U(feature)
    a, b = plane(depth) * m, plane(depth + 1) * m
    if SHUFFLE and words.size > 0:
        return sift((words, rows), a + start, a + stop, b + start, feature, cut) - b
    left, right = start, stop - U(1)
    for i in range(start, stop):
        row = rows[a + i]
        goes_left = U(keys[U(row) + column] <= cut)
        rows[b + left], rows[b + right] = row, row  # the next row corrects one
        left += goes_left
        right -= U(1) - goes_left
    return left


@uncounted
def _sort_down(nodes, values, root, descent, total):
    """Add one tree's predictions to `total`, sorting the rows down it."""
    stack, node, depth, top = descent.stack, root, 0, 0
    keys, shift, rows = descent.keys, descent.shift, descent.rows
    m = U(total.size)
    start, stop = U(0), m
    while True:
        child, feature, cut = nodes[node].child, nodes[node].feature, nodes[node].cut
        here = plane(depth) * m
        if feature < 0:
            for i in range(here + start, here + stop):
                total[U(rows[i]) >> shift] += values[child]
        elif nodes[child].feature & nodes[child + 1].feature < 0:
            # Both children are leaves: no need to sort.
            leaf, column = U(nodes[child].child), U(feature)
            for i in range(here + start, here + stop):
                row = U(rows[i])
                total[row >> shift] += values[leaf + U(keys[row + column] > cut)]
        else:
            left = sort_node(descent, m, depth, start, stop, feature, cut)
            depth += 1
            if left < stop:
                stack[top, 0], stack[top, 1] = child + 1, depth
                stack[top, 2], stack[top, 3] = left, stop
                top += 1
            if start < left:
                node, stop = np.int64(child), left
                continue
        if top == 0:
            return
        top -= 1
        node, depth = stack[top, 0], stack[top, 1]
        start, stop = U(stack[top, 2]), U(stack[top, 3])


@instructions
def prefetch(typing, array, i):
    """Begin to read array[i], so that its use in a moment does not wait."""

    def generate(context, b, signature, args):
        byte, flag = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, flag, flag, flag])
        function = get_or_insert_function(b.module, kind, "llvm.prefetch.p0i8")
        data = context.make_array(signature.args[0])(context, b, args[0]).data
        place = b.bitcast(b.gep(data, [args[1]]), byte)
        b.call(function, [place, flag(0), flag(3), flag(1)])  # a read, of data in use

    return types.void(array, types.uint64), generate


@instructions
def pointer(typing, address):
    """The pointer to an integer address."""

    def generate(context, b, signature, args):
        return b.inttoptr(args[0], ir.IntType(8).as_pointer())

    return types.voidptr(types.int64), generate


@compiled()
def _walk_down(nodes, values, first, descent, total):
    """Add all trees to `total`, the rows of some trees at a time, level by level.

    A walker is a row in a tree: a word of its number and of the node that it is at.
    """
    keys, shift, m, trees = descent.keys, descent.shift, U(total.size), first.size - 1
    some = max(1, WALKERS // total.size)
    walkers, column = np.empty((2, some * total.size), np.uint64)
    leaf = np.empty(some * total.size, np.int32)
    for begin in range(0, trees, some):
        end, left = min(begin + some, trees), U(0)
        for t in range(begin, end):
            for i in range(m):
                walkers[left] = (left << HIGH) | U(first[t])
                column[left] = U(i) << shift
                left += U(1)
        ahead = min(first[min(end + some, trees)], first[end] + AHEAD)
        for at in range(first[end], ahead, LINE):  # the next trees, if they are small
            prefetch(nodes, U(at))
        while left > U(0):
            walking = U(0)
            for j in range(left):
                who, at = walkers[j] >> HIGH, walkers[j] & LOW32
                cut, feature, child = nodes[at].cut, nodes[at].feature, nodes[at].child
                leaf[who] = child
                right = keys[column[who] + U(max(feature, np.int32(0)))] > cut
                after = U(child) + U(right)
                prefetch(nodes, after)
                walkers[walking] = (who << HIGH) | after
                walking += U(feature >= 0)  # the next one replaces a walker at its leaf
            left = walking
        for t in range(U(end - begin)):
            for i in range(m):
                total[i] += values[U(leaf[t * m + i])]


@kept(nogil=True)
def predict_addressed(table):
    """The means (m,) float64 over the trees of each forest at its own points (m, d).

    table (F, 7) int64: the addresses of a forest's nodes, values, first nodes and
    points (float32), the number of its trees, m and d. Compiled code takes no list of
    arrays without a copy, but it takes their addresses.
    """
    found = []
    for row in table:
        trees, m, d = row[4], row[5], row[6]
        first = carray(pointer(row[2]), (trees + 1,), np.int64)
        size = first[trees]
        nodes = carray(pointer(row[0]), (size,), NODE)
        values = carray(pointer(row[1]), ((size + trees) // 2,), np.float64)
        total = np.zeros(m)
        x = carray(pointer(row[3]), (m, d), np.float32)
        if m >= TOGETHER + size // trees // SHARE:
            part = max(1, CACHED // d)
            for begin in range(0, m, part):
                some, own = x[begin : begin + part], total[begin : begin + part]
                descent = new_descent(some)
                for t in range(trees):
                    _sort_down(nodes, values, first[t], descent, own)
        elif m > 0:
            _walk_down(nodes, values, first, new_descent(x), total)
        found.append(total / trees)
    return found
