"""Columns of the tables that the tracer reads, a class per table; `tracer.cu` numbers them alike."""


class Scene:
    """A table, its room, and where its instances and lights lie in their tables [m]."""

    INSTANCES, FIRST_INSTANCE = 0, 1
    TABLE_XY, THICKNESS, HALF_SIZE = slice(2, 4), 4, slice(5, 7)
    TABLE_KIND, TABLE_MATERIAL = 7, 8
    ROOM_LOW, ROOM_HIGH = slice(9, 12), slice(12, 15)
    FLOOR_Z, CEILING_Z = 11, 14
    FLOOR, WALL, CEILING, OTHER_WALL = 15, 16, 17, 18  # materials
    LIGHTS, FIRST_LIGHT = 19, 20
    AMBIENT = slice(21, 24)
    HAS_SKY, HORIZON, ZENITH = 24, slice(25, 28), slice(28, 31)  # whether walls are sky, and its colours
    WIDTH = 40


class Material:
    """A surface: two colours, a texture and how it lies, gloss, and a band or an inside of another colour."""

    TEXTURE, MAPPING = 0, 1
    SCALE, OFFSET = slice(2, 4), slice(4, 6)
    REPEATS, SHIFT = 2, 4  # of a texture that is wrapped
    COLOR, OTHER_COLOR, BLEND = slice(6, 9), slice(9, 12), 12
    ROUGHNESS, SPECULAR, CLEAR = 13, 14, 15
    TEXTURES = 16  # how many there are
    SIZE, LOW = slice(17, 20), slice(20, 23)  # of the box that a texture or a band covers
    TURN = 23
    BAND_AXIS, BAND, BAND_START, BAND_END = 24, slice(25, 27), 25, 26
    BAND_COLOR, HAS_INSIDE = slice(27, 30), 30  # the colour is that of the inside if there is one
    NEXT_FACE = 31
    WIDTH = 36


class Instance:
    """A mesh under an affine map: the inverse of the map by rows, and its box in the table's frame [m]."""

    TO_LOCAL, BOX = slice(0, 12), slice(12, 18)
    ROOT, MATERIAL, ID = 18, 19, 20
    WIDTH = 24


class Light:
    """A rectangle that shines to both sides: centre and half edges [m]."""

    CENTER, HALF_U, HALF_V = slice(0, 3), slice(3, 6), slice(6, 9)
    RADIANCE = slice(9, 12)
    WIDTH = 12


class View:
    """A camera in the table's frame [m], its axes (right, down, forward) as columns, focal lengths and centre [px]."""

    EYE, HEIGHT = slice(0, 3), 2
    AXES, UP = slice(3, 12), slice(9, 12)  # the latter is the table's normal in the camera's frame
    FOCAL, CENTER, INTRINSICS = slice(12, 14), slice(14, 16), slice(12, 16)
    SCENE, SEED = 16, 17
    HAS_TABLE, THINGS = 18, 19
    WIDTH = 20
