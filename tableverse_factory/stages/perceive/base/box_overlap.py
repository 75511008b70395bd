"""Areas and overlaps of axis-aligned boxes (xmin, ymin, xmax, ymax), in the square of their unit."""

Box4 = tuple[float, float, float, float]


def compute_area(box: Box4) -> float:
    """Compute the area of a box."""
    return (box[2] - box[0]) * (box[3] - box[1])


def intersect_boxes(a: Box4, b: Box4) -> float:
    """Compute the area that two boxes have in common."""
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    return width * height if width > 0 and height > 0 else 0.0


def compute_iou(a: Box4, b: Box4) -> float:
    """Compute intersection over union; 0 where the boxes do not overlap."""
    common = intersect_boxes(a, b)
    return common / (compute_area(a) + compute_area(b) - common) if common > 0 else 0.0


def compute_share_inside(a: Box4, b: Box4) -> float:
    """Compute the share of the area of `a` that lies in `b`."""
    return intersect_boxes(a, b) / compute_area(a)
