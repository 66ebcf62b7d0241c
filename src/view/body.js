// The body: a low figure that shows where its front and its head point.

const LIGHT = normalizedVector([0.4, 0.8, 0.45]);

// A box that may be narrower at one end: [half width, half depth] at either height.
function tapered(foot, [wf, df], head, [wh, dh], front) {
  const ring = (y, w, d) => [[-w, y, d], [w, y, d], [w, y, -d], [-w, y, -d]];
  return {
    vertices: [...ring(foot, wf, df), ...ring(head, wh, dh)],
    // Counter-clockwise seen from outside; the first looks forward.
    faces: [[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7], [4, 5, 6, 7], [3, 2, 1, 0]],
    front,
  };
}

// Trunk, shoulders, head and nose around the root, as convex parts that do not touch.
const BODY = [
  tapered(-0.14, [0.13, 0.08], 0.36, [0.17, 0.1], true),
  tapered(0.37, [0.24, 0.07], 0.45, [0.2, 0.06], true),
  tapered(0.49, [0.075, 0.09], 0.72, [0.09, 0.1], false),
  {
    vertices: [[-0.035, 0.57, 0.105], [0.035, 0.57, 0.105], [0, 0.64, 0.105], [0, 0.585, 0.2]],
    faces: [[0, 1, 3], [1, 2, 3], [2, 0, 3], [2, 1, 0]],
    front: 'all',
  },
];

// The corners of the least convex outline around points of the floor.
function outline(points) {
  const sorted = [...points].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const half = (ordered) => {
    const kept = [];
    for (const p of ordered) {
      for (;;) {
        const [a, b] = kept.slice(-2);
        if (!b || (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) > 0) break;
        kept.pop();
      }
      kept.push(p);
    }
    return kept.slice(0, -1);
  };
  return [...half(sorted), ...half(sorted.reverse())];
}

// Draws the body with its shadow, a line to the floor, an arrow where its front points, and a ring on beats.
function drawBody(stage, pose, flash, eye) {
  const { context, seen, onPage } = stage.pen;
  const { colors } = stage;
  const { position, quaternion } = pose;
  const placed = (v) => rotate(quaternion, v).map((c, i) => c + position[i]);
  const parts = BODY.map((part) => ({ ...part, vertices: part.vertices.map(placed) }));
  const fill = (points, style, alpha) => {
    const corners = points.map(seen);
    if (corners.some((c) => c[2] < NEAR)) return;
    context.beginPath();
    corners.map(onPage).forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
    context.closePath();
    context.globalAlpha = alpha;
    context.fillStyle = style;
    context.fill();
  };
  // The shadow of a light from above, the plumb line, and where the front points on the floor.
  const feet = parts.flatMap((part) => part.vertices.map((v) => [v[0], v[2]]));
  fill(outline(feet).map(([x, z]) => [x, 0, z]), '#000000', 0.22);
  context.globalAlpha = 1;
  const ground = [position[0], 0, position[2]];
  context.lineWidth = 1;
  context.strokeStyle = colors.axis;
  context.beginPath();
  stage.line(position, ground);
  context.stroke();
  const front = rotate(quaternion, [0, 0, 1]);
  const length = Math.hypot(front[0], front[2]);
  if (length > 0.05) {
    const [fx, fz] = [front[0] / length, front[2] / length];
    const at = (along, beside) =>
      [ground[0] + along * fx + beside * fz, 0, ground[2] + along * fz - beside * fx];
    const reach = 0.25 + 0.45 * length;
    fill([at(reach, 0), at(reach - 0.16, 0.09), at(reach - 0.16, -0.09)], colors.front, 0.9);
    context.globalAlpha = 0.9;
    context.lineWidth = 2;
    context.strokeStyle = colors.front;
    context.beginPath();
    stage.line(at(0.12, 0), at(reach - 0.14, 0));
    context.stroke();
  }
  if (flash > 0.02) {
    const ring = Array.from({ length: 36 }, (_, i) => {
      const angle = (i * Math.PI) / 18;
      const radius = 0.45 + 0.35 * (1 - flash);
      return [ground[0] + radius * Math.sin(angle), 0, ground[2] + radius * Math.cos(angle)];
    });
    context.globalAlpha = flash;
    context.strokeStyle = colors.beat;
    context.lineWidth = 2;
    context.beginPath();
    ring.forEach((p, i) => stage.line(p, ring[(i + 1) % ring.length]));
    context.stroke();
  }
  context.globalAlpha = 1;
  const depth = (part) =>
    part.vertices.reduce((sum, v) => sum + seen(v)[2], 0) / part.vertices.length;
  parts.sort((a, b) => depth(b) - depth(a));
  for (const { vertices, faces, front: marked } of parts) {
    faces.forEach((face, i) => {
      const corners = face.map((k) => vertices[k]);
      const [a, b, c] = corners;
      const normal = normalizedVector(
        cross(b.map((x, k) => x - a[k]), c.map((x, k) => x - a[k])),
      );
      if (dot(normal, a.map((x, k) => eye[k] - x)) <= 0) return;
      const isFront = marked === 'all' || (marked && i === 0);
      const light = 0.62 + 0.38 * Math.max(0, dot(normal, LIGHT));
      fill(corners, shaded(isFront ? colors.front : colors.body, light), 1);
    });
  }
  context.globalAlpha = 1;
}

// A colour #rrggbb made darker.
function shaded(color, light) {
  const parts = [1, 3, 5].map((i) => parseInt(color.slice(i, i + 2), 16));
  return `rgb(${parts.map((part) => Math.round(part * light)).join(' ')})`;
}
