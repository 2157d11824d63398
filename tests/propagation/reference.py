"""Channel matrices in 50 digits, by another route than the code: s/p decomposition at explicit reflection points."""

import itertools

import mpmath as mp

DIGITS = 50


def vec(values):
    return [mp.mpf(float(v)) if not isinstance(v, mp.mpf) else v for v in values]


def dot(a, b):
    return sum((x * y for x, y in zip(a, b, strict=True)), mp.mpf(0))


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def scaled(a, k):
    return [x * k for x in a]


def plus(a, b):
    return [x + y for x, y in zip(a, b, strict=True)]


def minus(a, b):
    return [x - y for x, y in zip(a, b, strict=True)]


def unit(a):
    return scaled(a, 1 / mp.sqrt(dot(a, a)))


def matvec(m, v):
    return [dot(row, v) for row in m]


def matrix(m):
    return [vec(row) for row in m]


def transpose(m):
    return [list(row) for row in zip(*m, strict=True)]


def fresnel(cos_theta, eta, thickness_m, wavelength):
    root = mp.sqrt(eta - 1 + cos_theta**2)
    te = (cos_theta - root) / (cos_theta + root)
    tm = (eta * cos_theta - root) / (eta * cos_theta + root)
    if thickness_m is not None:
        q = 2 * mp.pi * mp.mpf(thickness_m) / wavelength * root
        echo = mp.exp(-2j * q)
        te, tm = (r * (1 - echo) / (1 - r**2 * echo) for r in (te, tm))
    return te, tm


def element_field(turn, direction, slant, field):
    """Return the field vector in site axes of an element that sends along ``direction``.

    ``field`` is a function of theta and phi.
    """
    x, y, z = matvec(transpose(turn), direction)
    theta, phi = mp.acos(z), mp.atan2(y, x)
    e_theta, e_phi = field(theta, phi)
    c, s = mp.cos(slant), mp.sin(slant)
    f_theta, f_phi = e_theta * c - e_phi * s, e_theta * s + e_phi * c
    theta_hat = [mp.cos(theta) * mp.cos(phi), mp.cos(theta) * mp.sin(phi), -mp.sin(theta)]
    phi_hat = [-mp.sin(phi), mp.cos(phi), mp.mpf(0)]
    return matvec(turn, plus(scaled(theta_hat, f_theta), scaled(phi_hat, f_phi)))


def reflection_points(tx, rx, planes):
    """[tx, reflection points, rx], or None when they do not follow each other in this order."""
    images = [tx]
    for n, d, _, _ in planes:
        images.append(minus(images[-1], scaled(n, 2 * (dot(n, images[-1]) - d))))
    points = [rx]
    for (n, d, _, _), image in zip(planes[::-1], images[:0:-1], strict=True):
        step = minus(points[0], image)
        share = (d - dot(n, image)) / dot(n, step)
        if not 0 < share < 1:
            return None
        points.insert(0, plus(image, scaled(step, share)))
    points.insert(0, tx)
    return points


def unfolded(tx, rx, planes):
    """Length and directions of all legs from the last image, wherever the reflection points lie."""
    image = tx
    for n, d, _, _ in planes:
        image = minus(image, scaled(n, 2 * (dot(n, image) - d)))
    step = minus(rx, image)
    directions = [unit(step)]
    for n, _, _, _ in planes[::-1]:
        directions.insert(0, minus(directions[0], scaled(n, 2 * dot(n, directions[0]))))
    return mp.sqrt(dot(step, step)), directions


def path_amplitude(tx, rx, tx_turn, rx_turn, tx_slant, rx_slant, planes, wavelength, field):
    """One element pair over mirrors ``planes`` = [(normal, offset, eta, thickness)], from tx to rx.

    A path belongs to the array centres. Near a corner of two faces some pairs would meet them in the other order;
    for those the path is continued as if the faces had no end.
    """
    points = reflection_points(tx, rx, planes)
    if points is None:
        length, directions = unfolded(tx, rx, planes)
    else:
        steps = [minus(b, a) for a, b in itertools.pairwise(points)]
        length = sum((mp.sqrt(dot(step, step)) for step in steps), mp.mpf(0))
        directions = [unit(step) for step in steps]
    wave = element_field(tx_turn, directions[0], tx_slant, field)
    for (n, _, eta, thickness), before, after in zip(planes, directions[:-1], directions[1:], strict=True):
        te, tm = fresnel(abs(dot(before, n)), eta, thickness, wavelength)
        s = unit(cross(before, n))
        p_in, p_out = cross(s, before), cross(s, after)
        wave = plus(scaled(s, te * dot(s, wave)), scaled(p_out, tm * dot(p_in, wave)))
    received = dot(element_field(rx_turn, scaled(directions[-1], -1), rx_slant, field), wave)
    return received * wavelength / (4 * mp.pi * length) * mp.exp(-2j * mp.pi * length / wavelength)


def channel(tx_points, rx_points, tx_turn, rx_turn, tx_slants, rx_slants, paths, wavelength, field):
    """Return H as an mpmath matrix (rx, tx). ``paths`` is a list of lists of planes."""
    h = mp.matrix(len(rx_points), len(tx_points))
    for i, (r, rs) in enumerate(zip(rx_points, rx_slants, strict=True)):
        for j, (t, ts) in enumerate(zip(tx_points, tx_slants, strict=True)):
            h[i, j] = sum(
                (path_amplitude(t, r, tx_turn, rx_turn, ts, rs, planes, wavelength, field) for planes in paths),
                mp.mpf(0),
            )
    return h


def singular_values(h):
    """Descending."""
    return sorted(mp.svd_c(h, compute_uv=False), reverse=True)
