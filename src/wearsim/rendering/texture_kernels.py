"""Procedural colours, one point at a time: patterns of 2 to 50 cm without repetition.

A pattern is a function of a point's place on its face (a, b in m), of a seed and of the footprint: how wide (m)
the pixel or sample is that will hold the colour. What is finer than about two footprints fades to its mean, so
that nothing aliases. Colours are RGB 0…1 before the light.
"""

import math

from wearcap.geometry.compiled import compiled

PLASTER, BRICK, POSTER, BOOKS, WOOD, PARQUET, TILES, CARPET = range(8)
FABRIC, FOLIAGE, ASPHALT, STONE, PAINT, CEILING, LAMP = range(8, 15)


@compiled
def _chance(i, j, seed):
    """A deterministic number in [0, 1) for a cell."""
    h = (int(i) * 374761393 + int(j) * 668265263 + int(seed) * 974634777) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 1911520717) & 0xFFFFFFFF
    return ((h ^ (h >> 15)) & 0xFFFFFF) / 16777216.0


@compiled
def _fade(wavelength, footprint):
    """1 for wavelengths that a footprint resolves, 0 for finer ones."""
    return min(1.0, max(0.0, 0.6 * wavelength / footprint - 0.8))


@compiled
def _noise(a, b, wavelength, seed, footprint):
    """Smooth noise in [-1, 1] with cells of half a wavelength."""
    strength = _fade(wavelength, footprint)
    if strength <= 0.0:
        return 0.0
    x, y = 2.0 * a / wavelength, 2.0 * b / wavelength
    i, j = math.floor(x), math.floor(y)
    u, v = x - i, y - j
    u, v = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v)
    low = (1.0 - u) * _chance(i, j, seed) + u * _chance(i + 1, j, seed)
    high = (1.0 - u) * _chance(i, j + 1, seed) + u * _chance(i + 1, j + 1, seed)
    return strength * (2.0 * ((1.0 - v) * low + v * high) - 1.0)


@compiled
def _inside(distance, footprint):
    """Share of a footprint within an edge that is `distance` away, positive inwards."""
    return min(1.0, max(0.0, 0.5 + distance / footprint))


@compiled
def _joint(place, period, width, footprint):
    """Share of a footprint on lines of a width, one per period."""
    off = place - period * math.floor(place / period + 0.5)
    if footprint > 0.5 * period:
        return width / period
    return _inside(0.5 * width - abs(off), footprint) * min(1.0, width / footprint + 0.2)


@compiled
def _covered(red, green, blue, r, g, b, share):
    """One colour blended over another by its share."""
    return red + share * (r - red), green + share * (g - green), blue + share * (b - blue)


@compiled
def _hue(h):
    """A saturated colour of a hue angle 0…1."""
    red = min(1.0, max(0.0, abs(6.0 * h - 3.0) - 1.0))
    green = min(1.0, max(0.0, 2.0 - abs(6.0 * h - 2.0)))
    blue = min(1.0, max(0.0, 2.0 - abs(6.0 * h - 4.0)))
    return red, green, blue


@compiled
def _plaster(a, b, extent, red, green, blue, seed, footprint):
    """A painted wall: nearly blank, with a skirting board, sockets, and rarely a smudge."""
    shade = 1.0 + 0.012 * _noise(a, b, 1.4, seed, footprint) + 0.010 * _noise(a, b, 0.09, seed + 1, footprint)
    i, j = math.floor(a / 0.8), math.floor(b / 0.8)
    if _chance(i, j, seed + 2) < 0.10:
        x = a - (i + 0.25 + 0.5 * _chance(i, j, seed + 3)) * 0.8
        y = b - (j + 0.25 + 0.5 * _chance(i, j, seed + 4)) * 0.8
        reach = 0.03 + 0.08 * _chance(i, j, seed + 5)
        shade -= 0.10 * _inside(reach - math.hypot(x, 2.2 * y), 0.03 + footprint)
    red, green, blue = red * shade, green * shade, blue * shade
    if extent[3] - extent[2] > 0.8:
        plate, dark = 0.0, 0.0  # sockets, 30 cm above the floor on some stretches of wall
        cell = math.floor(a / 1.7)
        if _chance(cell, 3, seed + 6) <= 0.5:
            x = a - (cell + 0.2 + 0.6 * _chance(cell, 4, seed + 6)) * 1.7
            y = b - extent[2] - 0.3
            plate = _inside(0.04 - max(abs(x), abs(y)), footprint)
            hole = _inside(0.006 - math.hypot(abs(x) - 0.012, y), footprint)
            ring = _inside(0.003 - abs(math.hypot(x, y) - 0.027), footprint)
            dark = max(hole, 0.5 * ring)
        skirt = _inside(0.07 - (b - extent[2]), footprint)
        red, green, blue = _covered(red, green, blue, 0.35, 0.30, 0.26, skirt)
        red, green, blue = _covered(red, green, blue, 0.96, 0.96, 0.94, plate)
        red, green, blue = _covered(red, green, blue, 0.1, 0.1, 0.1, dark)
    return red, green, blue


@compiled
def _brick(a, b, red, green, blue, seed, footprint):
    """Courses of bricks in mortar, each brick of its own shade; weathered in large patches."""
    row = math.floor(b / 0.083)
    along = a / 0.25 + 0.5 * (row % 2)
    column = math.floor(along)
    visible = _fade(0.12, footprint)
    tone = 1.0 + visible * 0.55 * (_chance(column, row, seed) - 0.5)
    tone += 0.10 * _noise(a, b, 0.06, seed + 1, footprint) + 0.14 * _noise(a, b, 1.1, seed + 2, footprint)
    warm = visible * 0.10 * (_chance(column, row, seed + 3) - 0.5)
    mortar = max(_joint(b, 0.083, 0.012, footprint), _joint(along * 0.25, 0.25, 0.012, footprint))
    light = 0.62 + 0.05 * _noise(a, b, 0.2, seed + 4, footprint)
    red, green, blue = red * (tone + warm), green * tone, blue * (tone - warm)
    return _covered(red, green, blue, light, 0.98 * light, 0.93 * light, mortar)


@compiled
def _poster(a, b, extent, red, green, blue, seed, footprint):
    """A framed print; a large board has several sheets; a small object (a switch, a mug) gets a mark."""
    wide, tall = extent[1] - extent[0], extent[3] - extent[2]
    x, y = a - extent[0], b - extent[2]
    if min(wide, tall) < 0.12:
        mark = _inside(0.22 * min(wide, tall) - math.hypot(x - 0.5 * wide, y - 0.6 * tall), footprint)
        stripe = _inside(0.08 * tall - abs(y - 0.25 * tall), footprint)
        r, g, b = _hue(_chance(1, 1, seed))
        red, green, blue = _covered(red, green, blue, r, g, b, 0.7 * stripe)
        return _covered(red, green, blue, 0.1, 0.1, 0.15, mark)
    columns, rows = max(1.0, math.floor(wide / 0.42 + 0.5)), max(1.0, math.floor(tall / 0.42 + 0.5))
    if wide < 0.85 and tall < 0.85:
        columns, rows = 1.0, 1.0
    i, j = min(columns - 1, math.floor(x * columns / wide)), min(rows - 1, math.floor(y * rows / tall))
    own_wide, own_tall = wide / columns, tall / rows
    x, y, own = x - i * own_wide, y - j * own_tall, seed + 17 * i + 131 * j
    if columns * rows > 1:
        red, green, blue = 0.9 - 0.6 * _chance(i, j, seed + 1), 0.9 - 0.6 * _chance(i, j, seed + 2), 0.8
    # a sheet: shapes on a ground, lines of text below
    least = min(own_wide, own_tall)
    for shape in range(9):
        cx, cy = own_wide * _chance(shape, 0, own), own_tall * (0.25 + 0.75 * _chance(shape, 1, own))
        half_x = least * (0.06 + 0.30 * _chance(shape, 2, own))
        half_y = least * (0.06 + 0.30 * _chance(shape, 3, own))
        turn = 6.283 * _chance(shape, 4, own)
        u = math.cos(turn) * (x - cx) + math.sin(turn) * (y - cy)
        v = -math.sin(turn) * (x - cx) + math.cos(turn) * (y - cy)
        if _chance(shape, 5, own) < 0.4:
            cover = _inside(half_x - math.hypot(u, v), footprint)
        else:
            cover = _inside(min(half_x - abs(u), half_y - abs(v)), footprint)
        if cover > 0.0:
            r, g, b = _hue(_chance(shape, 6, own))
            lift = _chance(shape, 7, own)
            gray = 0.15 + 0.8 * _chance(shape, 8, own)
            r, g, b = _covered(gray, gray, gray, r, g, b, 0.8 * lift)
            red, green, blue = _covered(red, green, blue, r, g, b, cover)
    line, letter = 0.05 * least + 0.012, 0.03 * least + 0.008
    row = math.floor(y / line)
    if y < 0.3 * own_tall:
        column = math.floor(x / letter)
        ink = 1.0 if _chance(column, row, own + 9) < 0.66 else 0.0
        ink *= _inside(0.32 * line - abs(y - (row + 0.5) * line), footprint) * _fade(2.0 * letter, footprint)
        ink = max(ink, 0.3 * (1.0 - _fade(2.0 * letter, footprint)))
        red, green, blue = _covered(red, green, blue, 0.08, 0.08, 0.1, ink)
    rim = _inside(0.018 - min(min(x, own_wide - x), min(y, own_tall - y)), footprint)
    tone = 0.95 if _chance(0, 7, own) < 0.5 else 0.15
    return _covered(red, green, blue, tone, tone, tone, rim)


@compiled
def _books(a, b, extent, red, green, blue, seed, footprint):
    """Spines side by side, with titles and bands; darkness above the shorter ones."""
    width = 0.033
    place = a / width
    i = math.floor(place)
    first = i + 0.3 * (_chance(i, 0, seed) - 0.5)
    last = i + 1 + 0.3 * (_chance(i + 1, 0, seed) - 0.5)
    if place < first:
        i, first, last = i - 1, i - 1.0, first
    elif place > last:
        i, first, last = i + 1, last, i + 2.0
    tall = extent[3] - extent[2]
    y = b - extent[2]
    visible = _fade(1.5 * width, footprint)
    r, g, bl = _hue(_chance(i, 1, seed))
    dull, lift = 0.3 + 0.5 * _chance(i, 2, seed), 0.15 + 0.75 * _chance(i, 3, seed)
    r, g, bl = _covered(lift * r, lift * g, lift * bl, lift, lift, lift, dull)
    band_at = tall * (0.15 + 0.7 * _chance(i, 4, seed))
    band = _inside(0.012 + 0.05 * _chance(i, 5, seed) - abs(y - band_at), footprint)
    tone = 0.9 if lift < 0.5 else 0.1
    r, g, bl = _covered(r, g, bl, tone, tone, tone, 0.8 * band)
    gap = 1.0 - _inside(min(place - first, last - place) * width - 0.001, footprint)
    gap = max(0.8 * gap, _inside(y - tall * (0.72 + 0.28 * _chance(i, 6, seed)), footprint))
    r, g, bl = _covered(r, g, bl, 0.05, 0.05, 0.05, gap)
    return _covered(0.7 * red, 0.7 * green, 0.7 * blue, r, g, bl, visible)


@compiled
def _grain(along, across, red, green, blue, seed, footprint):
    """Wood: long streaks of several widths, here and there a knot."""
    bend = 0.012 * _noise(along, across, 0.7, seed + 1, footprint)
    y = across + bend
    tone = 0.16 * _noise(along * 0.06, y, 0.03, seed + 2, footprint)
    tone += 0.12 * _noise(along * 0.08, y, 0.09, seed + 3, footprint)
    i, j = math.floor(along / 0.55), math.floor(across / 0.22)
    if _chance(i, j, seed + 4) < 0.3:
        x = along - (i + 0.2 + 0.6 * _chance(i, j, seed + 5)) * 0.55
        y = across - (j + 0.2 + 0.6 * _chance(i, j, seed + 6)) * 0.22
        tone -= 0.40 * _inside(0.010 + 0.012 * _chance(i, j, seed + 7) - math.hypot(0.6 * x, y), 0.008 + footprint)
    tone += 1.0
    return red * tone, green * tone, blue * tone


@compiled
def _slabs(a, b, red, green, blue, seed, size, contrast, footprint):
    """Square tiles, flagstones or a rug's motifs with joints; a few are of another make, some are stained."""
    i, j = math.floor(a / size), math.floor(b / size)
    own = 1.0 + contrast * (_chance(i, j, seed) - 0.5) * _fade(size, footprint)
    own += 0.10 * _noise(a, b, 0.05, seed + 1, footprint) + 0.10 * _noise(a, b, 0.16, seed + 2, footprint)
    own += 0.08 * _noise(a, b, 0.9, seed + 3, footprint)
    red, green, blue = red * own, green * own, blue * own
    if _chance(i, j, seed + 4) < 0.07:
        x, y = a / size - i - 0.5, b / size - j - 0.5
        mark = _inside((0.30 - 0.22 * _chance(i, j, seed + 5) - abs(abs(x) - abs(y))) * size, footprint)
        r, g, bl = _hue(_chance(i, j, seed + 6))
        red, green, blue = _covered(red, green, blue, 0.3 + 0.4 * r, 0.3 + 0.4 * g, 0.3 + 0.4 * bl, 0.5 * mark)
    if _chance(i, j, seed + 7) < 0.25:
        x = a - (i + 0.2 + 0.6 * _chance(i, j, seed + 8)) * size
        y = b - (j + 0.2 + 0.6 * _chance(i, j, seed + 9)) * size
        stain = 0.28 * _inside(0.012 + 0.05 * _chance(i, j, seed + 10) - math.hypot(x, y), 0.012 + footprint)
        red, green, blue = red * (1 - stain), green * (1 - stain), blue * (1 - stain)
    gap = 0.6 * max(_joint(a, size, 0.008, footprint), _joint(b, size, 0.008, footprint))
    return _covered(red, green, blue, 0.25, 0.24, 0.23, gap)


@compiled
def _asphalt(a, b, red, green, blue, seed, footprint):
    """Asphalt: gravelly, mended in patches, cracked."""
    tone = 0.14 * _noise(a, b, 0.045, seed, footprint) + 0.10 * _noise(a, b, 0.13, seed + 1, footprint)
    tone += 0.10 * _noise(a, b, 1.6, seed + 2, footprint)
    i, j = math.floor(a / 1.9), math.floor(b / 1.9)
    if _chance(i, j, seed + 3) < 0.3:
        x, y = a / 1.9 - i - 0.5, b / 1.9 - j - 0.5
        half_x, half_y = 0.12 + 0.3 * _chance(i, j, seed + 4), 0.12 + 0.3 * _chance(i, j, seed + 5)
        tone -= 0.22 * _inside(1.9 * min(half_x - abs(x), half_y - abs(y)), footprint)
    crack = abs(_noise(a, b, 1.1, seed + 6, 0.001) + 0.3 * _noise(a, b, 0.2, seed + 7, 0.001))
    tone -= 0.35 * _inside(0.012 - crack * 0.35, 0.5 * footprint) * min(1.0, 0.03 / footprint)
    tone += 1.0
    return red * tone, green * tone, blue * tone


@compiled
def _ceiling(a, b, red, green, blue, seed, footprint):
    """Panels of 62 cm; some have a grille, a sprinkler or a stain."""
    size = 0.625
    i, j = math.floor(a / size), math.floor(b / size)
    tone = 1.0 + 0.05 * (_chance(i, j, seed) - 0.5) + 0.012 * _noise(a, b, 0.06, seed + 1, footprint)
    x, y = a - (i + 0.5) * size, b - (j + 0.5) * size
    kind = _chance(i, j, seed + 2)
    if kind < 0.06:
        tone -= 0.5 * _inside(0.2 - max(abs(x), abs(y)), footprint) * (0.3 + 0.7 * _joint(x, 0.05, 0.02, footprint))
    elif kind < 0.14:
        tone -= 0.5 * _inside(0.035 - math.hypot(x, y), footprint)
    elif kind < 0.2:
        tone -= 0.10 * _inside(0.15 - math.hypot(x, 1.4 * y), 0.08 + footprint)
    tone -= 0.22 * max(_joint(a, size, 0.02, footprint), _joint(b, size, 0.02, footprint))
    return red * tone, green * tone, blue * tone


@compiled
def _pattern(material, a, b, extent, red, green, blue, seed, footprint):
    """Colour of a material at (a, b)."""
    if material == PLASTER:
        return _plaster(a, b, extent, red, green, blue, seed, footprint)
    if material == BRICK:
        return _brick(a, b, red, green, blue, seed, footprint)
    if material == POSTER:
        return _poster(a, b, extent, red, green, blue, seed, footprint)
    if material == BOOKS:
        return _books(a, b, extent, red, green, blue, seed, footprint)
    if material == WOOD:
        if extent[1] - extent[0] < extent[3] - extent[2]:
            a, b = b, a
        return _grain(a, b, red, green, blue, seed, footprint)
    if material == PARQUET:
        # planks of 14 cm, each of its own shade, with open joints
        row = math.floor(b / 0.14)
        shifted = a + 1.3 * _chance(row, 0, seed)
        own = 1.0 + 0.42 * (_chance(math.floor(shifted / 1.3), row, seed + 1) - 0.5) * _fade(0.25, footprint)
        red, green, blue = _grain(a, b, red * own, green * own, blue * own, seed + 31 * row, footprint)
        gap = 0.75 * max(_joint(b, 0.14, 0.005, footprint), _joint(shifted, 1.3, 0.005, footprint))
        return _covered(red, green, blue, 0.12, 0.09, 0.07, gap)
    if material == TILES:
        return _slabs(a, b, red, green, blue, seed, 0.3, 0.16, footprint)
    if material == STONE:
        return _slabs(a, b, red, green, blue, seed, 0.45, 0.34, footprint)
    if material == CARPET:
        return _slabs(a, b, red, green, blue, seed, 0.22, 0.7, footprint)
    if material == FABRIC:
        # cloth with stripes or checks of its own width, and a worn surface
        width = 0.05 + 0.07 * _chance(0, 1, seed)
        visible = _fade(2.0 * width, footprint)
        tone = 1.0 + 0.28 * visible * (_chance(math.floor(a / width), 0, seed) - 0.5)
        if _chance(0, 2, seed) < 0.5:
            tone += 0.28 * visible * (_chance(math.floor(b / width), 7, seed) - 0.5)
        tone += 0.08 * _noise(a, b, 0.05, seed + 1, footprint) + 0.10 * _noise(a, b, 0.4, seed + 2, footprint)
        return red * tone, green * tone, blue * tone
    if material == FOLIAGE:
        # leaves or blades of grass: light and dark on every scale, yellower here, bluer there
        tone = 0.34 * _noise(a, b, 0.05, seed, footprint) + 0.28 * _noise(a, b, 0.11, seed + 1, footprint)
        tone += 0.22 * _noise(a, b, 0.3, seed + 2, footprint) + 0.16 * _noise(a, b, 1.2, seed + 3, footprint)
        warm = 0.22 * _noise(a, b, 0.5, seed + 4, footprint)
        return red * (1.0 + tone + warm), green * (1.0 + tone), blue * (1.0 + tone - warm)
    if material == ASPHALT:
        return _asphalt(a, b, red, green, blue, seed, footprint)
    if material == CEILING:
        return _ceiling(a, b, red, green, blue, seed, footprint)
    # lacquered wood, plastic or metal: even, with a few marks, labels and scratches
    tone = 1.0 + 0.03 * _noise(a, b, 0.5, seed, footprint) + 0.03 * _noise(a, b, 0.06, seed + 1, footprint)
    red, green, blue = red * tone, green * tone, blue * tone
    i, j = math.floor(a / 0.3), math.floor(b / 0.3)
    if _chance(i, j, seed + 2) >= 0.3:
        return red, green, blue
    x = a - (i + 0.2 + 0.6 * _chance(i, j, seed + 3)) * 0.3
    y = b - (j + 0.2 + 0.6 * _chance(i, j, seed + 4)) * 0.3
    half_x, half_y = 0.01 + 0.04 * _chance(i, j, seed + 5), 0.004 + 0.025 * _chance(i, j, seed + 6)
    mark = 0.6 * _inside(min(half_x - abs(x), half_y - abs(y)), footprint) * _fade(4.0 * half_y, footprint)
    to = 0.05 + 0.9 * _chance(i, j, seed + 7)
    return _covered(red, green, blue, to, to, to, mark)


@compiled
def color_points(points, face, facing, footprint, tables, light, out):
    """Lit colours (0…255 and beyond) of points of faces; entries without a face (-1) keep their value.

    `facing` is -1 where a face's back is seen; `tables` are `Paint.tables`, `light` is laid out as `texture.LIGHT`.
    """
    frames, extents, colors, materials, seeds = tables
    for k in range(len(points)):
        number = face[k]
        if number < 0:
            continue
        f, c, material = frames[number], colors[number], materials[number]
        px, py, pz = points[k, 0] - f[0], points[k, 1] - f[1], points[k, 2] - f[2]
        a = px * f[3] + py * f[4] + pz * f[5]
        b = px * f[6] + py * f[7] + pz * f[8]
        red, green, blue = _pattern(material, a, b, extents[number], c[0], c[1], c[2], seeds[number], footprint[k])
        shade = 250.0
        if material != LAMP:
            nx, ny, nz = facing[k] * f[9], facing[k] * f[10], facing[k] * f[11]
            key = light[3] * max(0.0, nx * light[0] + ny * light[1] + nz * light[2])
            shade = 255.0 * (light[4] + (light[5] - light[4]) * (0.5 + 0.5 * nz) + key)
        out[k, 0], out[k, 1], out[k, 2] = max(0.0, shade * red), max(0.0, shade * green), max(0.0, shade * blue)
