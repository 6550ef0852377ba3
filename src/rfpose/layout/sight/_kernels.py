"""Kernels of occlusion: straight rays against rectangular plates, found by a grid of cells, and an upright cylinder."""

from __future__ import annotations

import math

from rfpose.jit import kernel, kernel_rows


@kernel
def plate_hides(ax, ay, az, bx, by, bz, centre, rot, half_x, half_y, disc):
    """Whether the way from a to b crosses a rectangle of half sides (half_x, half_y), or a disc of radius half_x."""
    nx, ny, nz = rot[0, 2], rot[1, 2], rot[2, 2]
    da = (ax - centre[0]) * nx + (ay - centre[1]) * ny + (az - centre[2]) * nz
    db = (bx - centre[0]) * nx + (by - centre[1]) * ny + (bz - centre[2]) * nz
    if da * db >= 0.0:
        return False
    f = da / (da - db)
    x = ax + f * (bx - ax) - centre[0]
    y = ay + f * (by - ay) - centre[1]
    z = az + f * (bz - az) - centre[2]
    along_x = x * rot[0, 0] + y * rot[1, 0] + z * rot[2, 0]
    along_y = x * rot[0, 1] + y * rot[1, 1] + z * rot[2, 1]
    if disc:
        return along_x * along_x + along_y * along_y < half_x * half_x
    return abs(along_x) < half_x and abs(along_y) < half_y


@kernel
def tower_hides(ax, ay, az, bx, by, bz, tower):
    """Whether the way from a to b enters the upright cylinder (x, y, radius, bottom, top)."""
    radius = tower[2]
    if not radius > 0.0:
        return False
    dx, dy, dz = bx - ax, by - ay, bz - az
    ox, oy = ax - tower[0], ay - tower[1]
    a = dx * dx + dy * dy
    b = ox * dx + oy * dy
    c = ox * ox + oy * oy - radius * radius
    low, high = 0.0, 1.0
    if a > 0.0:
        root = b * b - a * c
        if root <= 0.0:
            return False
        root = math.sqrt(root)
        low, high = max(low, (-b - root) / a), min(high, (-b + root) / a)
    elif c >= 0.0:
        return False
    if dz != 0.0:
        first, second = (tower[3] - az) / dz, (tower[4] - az) / dz
        low, high = max(low, min(first, second)), min(high, max(first, second))
    elif az <= tower[3] or az >= tower[4]:
        return False
    return low < high


@kernel
def neighbours_hide(
    m, ax, ay, az, bx, by, bz, centre, rot, half_x, half_y, disc, reach, top, x0, y0, cell, start, member
):
    """Whether any plate but ``m`` stands in the way; walks along the ray through cells of side ``cell``."""
    n_column, n_row = start.shape[0], start.shape[1] - 1
    dx, dy, dz = bx - ax, by - ay, bz - az
    flat = math.sqrt(dx * dx + dy * dy)
    end = 1.0
    if dz > 0.0:
        # above the highest edge of any plate nothing is in the way
        end = min(1.0, (top - az) / dz)
    if end <= 0.0:
        return False
    n_step = int(end * flat / cell) + 1
    last_i, last_j = -9, -9
    for k in range(n_step + 1):
        f = end * k / n_step
        i = math.floor((ax + f * dx - x0) / cell)
        j = math.floor((ay + f * dy - y0) / cell)
        if i == last_i and j == last_j:
            continue
        last_i, last_j = i, j
        for column in range(max(0, i - 1), min(n_column, i + 2)):
            for row in range(max(0, j - 1), min(n_row, j + 2)):
                for p in range(start[column, row], start[column, row + 1]):
                    o = member[p]
                    if o == m:
                        continue
                    # distance of the plate's centre from the ray, before its exact outline
                    cx, cy, cz = centre[o, 0] - ax, centre[o, 1] - ay, centre[o, 2] - az
                    t = (cx * dx + cy * dy + cz * dz) / (flat * flat + dz * dz)
                    t = min(1.0, max(0.0, t))
                    gx, gy, gz = cx - t * dx, cy - t * dy, cz - t * dz
                    if gx * gx + gy * gy + gz * gz > reach * reach:
                        continue
                    if plate_hides(ax, ay, az, bx, by, bz, centre[o], rot[o], half_x, half_y, disc):
                        return True
    return False


@kernel_rows
def visible_rows(
    begin, end, transmitter, receiver, who, centre, rot, half_x, half_y, disc, reach, top, tower, x0, y0, cell, start,
    member, out,
):  # fmt: skip
    """Fill ``out`` (row, receiver, transmitter) with one where the way is free; row i belongs to plate ``who[i]``."""
    n_receiver, n_transmitter = out.shape[1:]
    for i in range(begin, end):
        m = who[i]
        for r in range(n_receiver):
            ax, ay, az = receiver[i, r, 0], receiver[i, r, 1], receiver[i, r, 2]
            for t in range(n_transmitter):
                bx, by, bz = transmitter[t, 0], transmitter[t, 1], transmitter[t, 2]
                hidden = plate_hides(ax, ay, az, bx, by, bz, centre[m], rot[m], half_x, half_y, disc)
                if not hidden:
                    hidden = tower_hides(ax, ay, az, bx, by, bz, tower)
                if not hidden:
                    hidden = neighbours_hide(
                        m,
                        ax,
                        ay,
                        az,
                        bx,
                        by,
                        bz,
                        centre,
                        rot,
                        half_x,
                        half_y,
                        disc,
                        reach,
                        top,
                        x0,
                        y0,
                        cell,
                        start,
                        member,
                    )
                out[i, r, t] = 0 if hidden else 1
