// Path tracer of training views: instances of meshes, a table-top, a room, rectangular lights; one diffuse bounce.
// Compiled by NVRTC for a GPU; a C++ compiler takes it too, and tests compare its labels with those of embree.
#ifdef __CUDACC__
#define DEVICE __device__ __forceinline__
#else
#include <cmath>
#include <cstddef>
#define DEVICE static inline
#endif
typedef unsigned int u32;
typedef unsigned char u8;
typedef signed char s8;

// Lengths of the rows of the tables whose columns `columns.py` names, and the ids of a table.
enum { INSTANCE = 24, MATERIAL = 36, SCENE = 40, LIGHT = 12, VIEW = 20 };
enum { TABLE_TOP = 255, TABLE_SIDE = 254 };
enum { OF_ROOM = 1, OF_TABLE = 2, OF_MESH = 3 };

struct Vec { float x, y, z; };
DEVICE Vec vec(float x, float y, float z) { Vec v; v.x = x; v.y = y; v.z = z; return v; }
DEVICE Vec operator+(Vec a, Vec b) { return vec(a.x + b.x, a.y + b.y, a.z + b.z); }
DEVICE Vec operator-(Vec a, Vec b) { return vec(a.x - b.x, a.y - b.y, a.z - b.z); }
DEVICE Vec operator*(Vec a, Vec b) { return vec(a.x * b.x, a.y * b.y, a.z * b.z); }
DEVICE Vec operator*(Vec a, float s) { return vec(a.x * s, a.y * s, a.z * s); }
DEVICE float dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
DEVICE Vec cross(Vec a, Vec b) { return vec(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x); }
DEVICE Vec unit(Vec a) { return a * (1.0f / sqrtf(fmaxf(dot(a, a), 1e-20f))); }
DEVICE Vec load(const float* p) { return vec(p[0], p[1], p[2]); }
DEVICE Vec clip(Vec a, float most) { return vec(fminf(a.x, most), fminf(a.y, most), fminf(a.z, most)); }

DEVICE float draw(u32& state) {  // PCG, uniform in 0-1
  state = state * 747796405u + 2891336453u;
  u32 word = ((state >> ((state >> 28) + 4u)) ^ state) * 277803737u;
  return (((word >> 22) ^ word) >> 8) * (1.0f / 16777216.0f);
}

struct World {
  const float *nodes, *triangles, *normals, *instances, *materials, *scenes, *lights;
  const u8* textures;
  int texture_side;
};
struct Hit { float t; int kind, instance, triangle, wall; float u, v; Vec n; };
struct Surface { Vec p, n, geometric, albedo; float rough, specular, clear; int id; };

DEVICE Vec invert(Vec d) {
  return vec(1.0f / (fabsf(d.x) < 1e-9f ? 1e-9f : d.x), 1.0f / (fabsf(d.y) < 1e-9f ? 1e-9f : d.y),
             1.0f / (fabsf(d.z) < 1e-9f ? 1e-9f : d.z));
}
DEVICE bool crosses(Vec o, Vec inv, const float* box, float most) {
  float x0 = (box[0] - o.x) * inv.x, x1 = (box[3] - o.x) * inv.x, y0 = (box[1] - o.y) * inv.y;
  float y1 = (box[4] - o.y) * inv.y, z0 = (box[2] - o.z) * inv.z, z1 = (box[5] - o.z) * inv.z;
  float in = fmaxf(fmaxf(fminf(x0, x1), fminf(y0, y1)), fmaxf(fminf(z0, z1), 0.0f));
  float out = fminf(fminf(fmaxf(x0, x1), fmaxf(y0, y1)), fminf(fmaxf(z0, z1), most));
  return in <= out;
}
// A node: box, first child or triangle, number of triangles (0 for an inner node, whose children are adjacent).
DEVICE bool hit_mesh(const World& w, int root, Vec o, Vec d, Hit& h, bool any) {
  int stack[32], depth = 0;
  bool found = false;
  Vec inv = invert(d);
  stack[depth++] = root;
  while (depth) {
    const float* node = w.nodes + 8 * stack[--depth];
    if (!crosses(o, inv, node, h.t)) continue;
    int first = (int)node[6], count = (int)node[7];
    if (!count) { stack[depth++] = first; stack[depth++] = first + 1; continue; }
    for (int k = first; k < first + count; k++) {
      const float* t = w.triangles + 9 * k;
      Vec e1 = load(t + 3), e2 = load(t + 6), p = cross(d, e2);
      float det = dot(e1, p);
      if (fabsf(det) < 1e-14f) continue;
      float id = 1.0f / det;
      Vec s = o - load(t);
      float u = dot(s, p) * id;
      if (u < 0.f || u > 1.f) continue;
      Vec r = cross(s, e1);
      float v = dot(d, r) * id;
      if (v < 0.f || u + v > 1.f) continue;
      float far = dot(e2, r) * id;
      if (far > 1e-5f && far < h.t) {
        h.t = far; h.triangle = k; h.u = u; h.v = v; found = true;
        if (any) return true;
      }
    }
  }
  return found;
}
DEVICE Vec to_local(const float* m, Vec d) {
  return vec(m[0] * d.x + m[1] * d.y + m[2] * d.z, m[4] * d.x + m[5] * d.y + m[6] * d.z,
             m[8] * d.x + m[9] * d.y + m[10] * d.z);
}
DEVICE Vec normal_to_world(const float* m, Vec n) {
  return vec(m[0] * n.x + m[4] * n.y + m[8] * n.z, m[1] * n.x + m[5] * n.y + m[9] * n.z,
             m[2] * n.x + m[6] * n.y + m[10] * n.z);
}
// Scene: 0 instances, 1 first, 2 table x, y, thickness, half x, half y, 7 kind (0 none, 1 slab, 2 disc), 8 material,
// 9 room low and high, 15 materials of floor, wall, ceiling, other wall, 19 lights, 20 first, 21 ambient,
// 24 whether walls are sky, 25 its colour at the horizon, 28 above.
DEVICE bool hit_table(const float* scene, Vec o, Vec d, Vec inv, float& t, Vec& n) {
  if (scene[7] < 0.5f) return false;
  if (scene[7] > 1.5f) {
    for (int side = 0; side < 2; side++) {  // upper and lower face of a thin disc
      float to = (-side * scene[4] - o.z) * inv.z;
      if (to <= 1e-5f || to >= t) continue;
      float x = o.x + to * d.x - scene[2], y = o.y + to * d.y - scene[3];
      if (x * x + y * y > scene[5] * scene[5]) continue;
      t = to; n = vec(0, 0, d.z > 0 ? -1 : 1);
      return true;
    }
    float ox = o.x - scene[2], oy = o.y - scene[3], a = d.x * d.x + d.y * d.y, b = ox * d.x + oy * d.y;
    float root = b * b - a * (ox * ox + oy * oy - scene[5] * scene[5]);
    if (root <= 0.f || a < 1e-12f) return false;
    float to = (-b - sqrtf(root)) / a, z = o.z + to * d.z;
    if (to <= 1e-5f || to >= t || z > 0.f || z < -scene[4]) return false;
    t = to; n = unit(vec(ox + to * d.x, oy + to * d.y, 0));
    return true;
  }
  float x0 = (scene[2] - scene[5] - o.x) * inv.x, x1 = (scene[2] + scene[5] - o.x) * inv.x;
  float y0 = (scene[3] - scene[6] - o.y) * inv.y, y1 = (scene[3] + scene[6] - o.y) * inv.y;
  float z0 = (-scene[4] - o.z) * inv.z, z1 = -o.z * inv.z;
  float ax = fminf(x0, x1), ay = fminf(y0, y1), az = fminf(z0, z1), in = fmaxf(fmaxf(ax, ay), az);
  float out = fminf(fminf(fmaxf(x0, x1), fmaxf(y0, y1)), fmaxf(z0, z1));
  if (in > out || in <= 1e-5f || in >= t) return false;
  t = in;
  n = in == ax ? vec(d.x > 0 ? -1 : 1, 0, 0) : in == ay ? vec(0, d.y > 0 ? -1 : 1, 0) : vec(0, 0, d.z > 0 ? -1 : 1);
  return true;
}
DEVICE void hit_room(const float* scene, Vec o, Vec d, Vec inv, Hit& h) {
  float x = d.x > 0 ? (scene[12] - o.x) * inv.x : (scene[9] - o.x) * inv.x;
  float y = d.y > 0 ? (scene[13] - o.y) * inv.y : (scene[10] - o.y) * inv.y;
  float z = d.z > 0 ? (scene[14] - o.z) * inv.z : (scene[11] - o.z) * inv.z;
  h.kind = OF_ROOM;
  if (z <= x && z <= y) { h.t = z; h.n = vec(0, 0, d.z > 0 ? -1 : 1); h.wall = d.z > 0 ? 17 : 15; }
  else if (x <= y) { h.t = x; h.n = vec(d.x > 0 ? -1 : 1, 0, 0); h.wall = 16; }
  else { h.t = y; h.n = vec(0, d.y > 0 ? -1 : 1, 0); h.wall = 18; }
}
DEVICE void trace(const World& w, const float* scene, Vec o, Vec d, Hit& h) {
  Vec inv = invert(d), n;
  hit_room(scene, o, d, inv, h);
  if (hit_table(scene, o, d, inv, h.t, n)) { h.kind = OF_TABLE; h.n = n; }
  int first = (int)scene[1], end = first + (int)scene[0];
  for (int i = first; i < end; i++) {
    const float* row = w.instances + INSTANCE * i;
    if (!crosses(o, inv, row + 12, h.t)) continue;
    Vec local = to_local(row, o) + vec(row[3], row[7], row[11]);
    if (hit_mesh(w, (int)row[18], local, to_local(row, d), h, false)) { h.kind = OF_MESH; h.instance = i; }
  }
}
DEVICE bool is_blocked(const World& w, const float* scene, Vec o, Vec d, float most, u32& state) {
  Vec inv = invert(d), n;
  Hit h;
  h.t = most;
  if (hit_table(scene, o, d, inv, h.t, n)) return true;
  int first = (int)scene[1], end = first + (int)scene[0];
  for (int i = first; i < end; i++) {
    const float* row = w.instances + INSTANCE * i;
    if (!crosses(o, inv, row + 12, most)) continue;
    if (draw(state) < 0.8f * w.materials[MATERIAL * (int)row[19] + 15]) continue;  // light passes through glass
    h.t = most;
    Vec local = to_local(row, o) + vec(row[3], row[7], row[11]);
    if (hit_mesh(w, (int)row[18], local, to_local(row, d), h, true)) return true;
  }
  return false;
}
DEVICE Vec texel(const World& w, int texture, float u, float v) {
  int side = w.texture_side;
  u = (u - floorf(u)) * side - 0.5f; v = (v - floorf(v)) * side - 0.5f;
  float fu = floorf(u), fv = floorf(v), a = u - fu, b = v - fv;
  int x0 = ((int)fu + side) % side, y0 = ((int)fv + side) % side, x1 = (x0 + 1) % side, y1 = (y0 + 1) % side;
  const u8* base = w.textures + (size_t)texture * side * side * 3;
  const u8 *p = base + 3 * (y0 * side + x0), *q = base + 3 * (y0 * side + x1);
  const u8 *r = base + 3 * (y1 * side + x0), *s = base + 3 * (y1 * side + x1);
  float c0 = (1 - a) * (1 - b), c1 = a * (1 - b), c2 = (1 - a) * b, c3 = a * b;
  return vec(p[0] * c0 + q[0] * c1 + r[0] * c2 + s[0] * c3, p[1] * c0 + q[1] * c1 + r[1] * c2 + s[1] * c3,
             p[2] * c0 + q[2] * c1 + r[2] * c2 + s[2] * c3) * (1.0f / 255.0f);
}
DEVICE float linear(float c) { return c * c * (0.2f + 0.8f * c); }
DEVICE Vec linear(Vec c) { return vec(linear(c.x), linear(c.y), linear(c.z)); }

// Material: 0 texture, 1 mapping (0 tiled, 1 a texture per pair of faces of the box, 2 wrapped about z), 2 scale,
// 4 offset, 6 and 9 colours A and B, 12 blend (0 A, 1 A to B by the texture, 2 A times texture, 3 texture),
// 13 roughness, 14 specular, 15 clear, 16 number of textures, 17 size, 20 low corner, 23 turn, 24 axis of a band,
// 25 its ends as shares of the size, 27 its colour, 30 whether the colour is of the inside instead, 31 next face.
DEVICE Vec paint(const World& w, const float* m, Vec p, Vec n) {
  Vec share = vec((p.x - m[20]) / m[17], (p.y - m[21]) / m[18], (p.z - m[22]) / m[19]);
  if (m[30] > 0.5f) {
    float x = share.x - 0.5f, y = share.y - 0.5f;
    if (n.x * x * m[17] + n.y * y * m[18] < -1e-6f || (n.z > 0.8f && share.z < 0.8f)) return linear(load(m + 27));
  } else {
    float along = m[24] < 0.5f ? share.x : m[24] < 1.5f ? share.y : share.z;
    if (along >= m[25] && along <= m[26]) return linear(load(m + 27));
  }
  Vec a = load(m + 6);
  int blend = (int)m[12], mapping = (int)m[1], texture = (int)m[0];
  if (!blend) return linear(a);
  float ax = fabsf(n.x), ay = fabsf(n.y), az = fabsf(n.z), u, v;
  if (mapping == 2 && az <= 0.8f) {
    u = atan2f(share.y - 0.5f, share.x - 0.5f) * 0.15915494f * floorf(m[2] + 0.5f) + m[4];
    v = 1.0f - share.z;
  } else if (mapping) {
    int face = 2;
    if (az >= ax && az >= ay) { u = share.x; v = 1 - share.y; face = 0; }
    else if (ax >= ay) { u = n.x > 0 ? share.y : 1 - share.y; v = 1 - share.z; face = 1; }
    else { u = n.y > 0 ? 1 - share.x : share.x; v = 1 - share.z; }
    if (m[23] > 0.5f) { float t = u; u = v; v = 1 - t; }
    texture += face * (int)m[31];
  } else {
    u = az >= ax && az >= ay ? p.x : ax >= ay ? p.y : p.x;
    v = az >= ax && az >= ay ? p.y : p.z;
    float c = cosf(m[23]), s = sinf(m[23]), turned = c * u - s * v;
    v = (s * u + c * v) * m[3] + m[5];
    u = turned * m[2] + m[4];
  }
  Vec t = texel(w, texture % (int)m[16], u, v);
  if (blend == 3) return linear(t);
  if (blend == 2) return linear(a * t);
  float grey = 0.3f * t.x + 0.59f * t.y + 0.11f * t.z;
  return linear(a * (1 - grey) + load(m + 9) * grey);
}
DEVICE void describe(const World& w, const float* scene, Vec o, Vec d, const Hit& h, Surface& s) {
  const float* m;
  s.p = o + d * h.t;
  if (h.kind == OF_MESH) {
    const float* row = w.instances + INSTANCE * h.instance;
    const float *t = w.triangles + 9 * h.triangle, *c = w.normals + 9 * h.triangle;
    Vec flat = cross(load(t + 3), load(t + 6));
    Vec smooth = load(c) * (1 - h.u - h.v) + load(c + 3) * h.u + load(c + 6) * h.v;
    s.geometric = unit(normal_to_world(row, flat));
    s.n = unit(normal_to_world(row, smooth));
    m = w.materials + MATERIAL * (int)row[19];
    s.albedo = paint(w, m, to_local(row, s.p) + vec(row[3], row[7], row[11]), unit(flat));
    s.id = (int)row[20];
    if (dot(s.geometric, d) > 0) s.geometric = s.geometric * -1.0f;
    if (dot(s.n, s.geometric) < 0) s.n = s.n * -1.0f;
  } else {
    s.n = s.geometric = h.n;
    m = w.materials + MATERIAL * (int)(h.kind == OF_TABLE ? scene[8] : scene[h.wall]);
    s.albedo = paint(w, m, s.p, h.n);
    s.id = h.kind == OF_ROOM ? 0 : h.n.z > 0.5f ? TABLE_TOP : TABLE_SIDE;
  }
  s.rough = m[13]; s.specular = m[14]; s.clear = m[15];
}
DEVICE bool is_sky(const float* scene, const Hit& h) { return h.kind == OF_ROOM && scene[24] > 0.5f && h.wall != 15; }
DEVICE Vec shine_sky(const float* scene, Vec d) {
  float up = fminf(fmaxf(d.z * 1.6f, 0.f), 1.f);
  return load(scene + 25) * (1 - up) + load(scene + 28) * up;
}
// Light: 0 centre, 3 and 6 half edges, 9 radiance.
DEVICE Vec gather(const World& w, const float* scene, const Surface& s, u32& state) {
  int count = (int)scene[19];
  if (!count) return vec(0, 0, 0);
  int chosen = (int)(draw(state) * count);
  const float* light = w.lights + LIGHT * ((int)scene[20] + (chosen < count ? chosen : count - 1));
  Vec u = load(light + 3), v = load(light + 6);
  Vec to = load(light) + u * (2 * draw(state) - 1) + v * (2 * draw(state) - 1) - s.p;
  float square = dot(to, to), far = sqrtf(square);
  Vec l = to * (1 / far), facing = cross(u, v);
  float cosine = dot(s.n, l);
  if (cosine <= 0 || dot(s.geometric, l) <= 0) return vec(0, 0, 0);
  if (is_blocked(w, scene, s.p + s.geometric * 2e-4f, l, far * 0.999f, state)) return vec(0, 0, 0);
  return load(light + 9) * (cosine * fabsf(dot(facing, l)) * 4 * count / (fmaxf(square, 0.01f) * 3.14159265f));
}
DEVICE Vec turn_to(Vec n, float x, float y, float z) {
  float s = n.z >= 0 ? 1.0f : -1.0f, a = -1.0f / (s + n.z), b = n.x * n.y * a;
  return unit(vec(1 + s * n.x * n.x * a, s * b, -s * n.x) * x + vec(b, s + n.y * n.y * a, -n.y) * y + n * z);
}
// Radiance along a ray that left a surface: one more surface, lit by a light and the ambient term.
DEVICE Vec look(const World& w, const float* scene, Vec o, Vec d, bool lights, u32& state) {
  Hit h;
  Surface s;
  trace(w, scene, o, d, h);
  if (lights) {
    int first = (int)scene[20], end = first + (int)scene[19];
    for (int k = first; k < end; k++) {
      const float* light = w.lights + LIGHT * k;
      Vec u = load(light + 3), v = load(light + 6), n = cross(u, v);
      float along = dot(d, n);
      if (fabsf(along) < 1e-9f) continue;
      float t = dot(load(light) - o, n) / along;
      if (t <= 0 || t >= h.t) continue;
      Vec q = o + d * t - load(light);
      if (fabsf(dot(q, u)) < dot(u, u) && fabsf(dot(q, v)) < dot(v, v)) return clip(load(light + 9), 30.f);
    }
  }
  if (is_sky(scene, h)) return shine_sky(scene, d);
  describe(w, scene, o, d, h, s);
  return s.albedo * clip(gather(w, scene, s, state) + load(scene + 21), 8.f);
}
// What is seen through up to four clear surfaces.
DEVICE Vec look_through(const World& w, const float* scene, Vec o, Vec d, u32& state) {
  Vec tint = vec(1, 1, 1);
  for (int k = 0; k < 4; k++) {
    Hit h;
    Surface s;
    trace(w, scene, o, d, h);
    if (is_sky(scene, h)) return tint * shine_sky(scene, d);
    describe(w, scene, o, d, h, s);
    if (s.clear <= 0.f) return tint * s.albedo * clip(gather(w, scene, s, state) + load(scene + 21), 8.f);
    tint = tint * (vec(1, 1, 1) * 0.9f + s.albedo * 0.1f);
    o = s.p - s.geometric * 2e-4f;
  }
  return tint * load(scene + 21);
}
DEVICE Vec reflect(const World& w, const float* scene, Vec d, const Surface& s, float floor, u32& state) {
  float cosine = fmaxf(-dot(d, s.n), 0.f);
  float share = fmaxf(s.specular, floor);
  share += (1 - share) * powf(1 - cosine, 5.f) * (1 - s.rough);
  float z = 2 * draw(state) - 1, angle = draw(state) * 6.2831853f, q = sqrtf(1 - z * z);
  float spread = s.rough * powf(draw(state), 0.333f);
  Vec r = unit(d - s.n * (2 * dot(d, s.n)) + vec(q * cosf(angle), q * sinf(angle), z) * spread);
  if (dot(r, s.geometric) <= 0.f || share < 0.005f) return vec(0, 0, 0);
  return clip(look(w, scene, s.p + s.geometric * 2e-4f, r, true, state), 15.f) * share;
}
struct Pixel { float* light; float* depth; u8* id; s8* normal; u8* shine; };

// View: 0 eye, 3 rotation of camera axes (right, down, forward) to the world by rows, 12 focal lengths, 14 centre,
// 16 scene, 17 seed, 18 whether there is a table, 19 number of things. Light is irradiance, albedo, gloss (3 floats each);
// the rest is of the ray through the centre.
DEVICE void expose(const World& w, const float* view, int width, int x, int y, int samples, Pixel out) {
  const float* scene = w.scenes + SCENE * (int)view[16];
  u32 state = (u32)view[17] * 9781u + (u32)(y * width + x) * 6151u + 77u;
  draw(state);
  Vec irradiance = vec(0, 0, 0), albedo = vec(0, 0, 0), gloss = vec(0, 0, 0), o = load(view);
  for (int k = 0; k < samples; k++) {
    float cx = (x + (k ? draw(state) - 0.5f : 0.f) - view[14]) / view[12];
    float cy = (y + (k ? draw(state) - 0.5f : 0.f) - view[15]) / view[13];
    Vec along = vec(view[3] * cx + view[4] * cy + view[5], view[6] * cx + view[7] * cy + view[8],
                    view[9] * cx + view[10] * cy + view[11]);
    Vec d = unit(along);
    Hit h;
    Surface s;
    trace(w, scene, o, d, h);
    describe(w, scene, o, d, h, s);
    if (k == 0) {
      *out.depth = h.t / sqrtf(dot(along, along));
      *out.id = (u8)s.id;
      *out.shine = (u8)(255.f * fminf(fmaxf(s.clear, s.specular * 2.f * (1.f - s.rough)), 1.f));
      for (int axis = 0; axis < 3; axis++)
        out.normal[axis] =
            (s8)rintf(127.f * (view[3 + axis] * s.n.x + view[6 + axis] * s.n.y + view[9 + axis] * s.n.z));
    }
    if (is_sky(scene, h)) { gloss = gloss + shine_sky(scene, d); continue; }
    Vec e = gather(w, scene, s, state);
    float angle = draw(state) * 6.2831853f, r = draw(state), root = sqrtf(r);
    Vec bounce = turn_to(s.n, root * cosf(angle), root * sinf(angle), sqrtf(1 - r));
    if (dot(bounce, s.geometric) > 0) e = e + look(w, scene, s.p + s.geometric * 2e-4f, bounce, false, state);
    irradiance = irradiance + clip(e, 12.f);
    albedo = albedo + s.albedo * (1 - s.clear);
    if (s.clear > 0.f) {
      Vec through = look_through(w, scene, s.p - s.geometric * 2e-4f, d, state);
      gloss = gloss + through * (vec(1, 1, 1) * 0.8f + s.albedo * 0.2f) * s.clear;
    }
    if (s.specular > 0.f || s.clear > 0.f) gloss = gloss + reflect(w, scene, d, s, 0.05f * (s.clear > 0.f), state);
  }
  float q = 1.0f / samples;
  Vec parts[3] = {irradiance * q, albedo * q, gloss * q};
  for (int k = 0; k < 3; k++) {
    out.light[3 * k] = parts[k].x; out.light[3 * k + 1] = parts[k].y; out.light[3 * k + 2] = parts[k].z;
  }
}
#define PARAMETERS                                                                                                    \
  const float *nodes, const float *triangles, const float *normals, const float *instances, const float *materials,   \
      const float *scenes, const float *lights, const u8 *textures, int texture_side, const float *views, int count,  \
      int width, int height, int samples, float *light, float *depth, u8 *id, s8 *normal, u8 *shine
#define EXPOSE(v, x, y)                                                                                               \
  {                                                                                                                   \
    World w = {nodes, triangles, normals, instances, materials, scenes, lights, textures, texture_side};              \
    size_t k = ((size_t)(v) * height + (y)) * width + (x);                                                            \
    Pixel out = {light + 9 * k, depth + k, id + k, normal + 3 * k, shine + k};                                        \
    expose(w, views + VIEW * (v), width, x, y, samples, out);                                                         \
  }
#ifdef __CUDACC__
extern "C" __global__ void render(PARAMETERS) {
  int x = blockIdx.x * 8 + (threadIdx.x & 7), y = blockIdx.y * 8 + (threadIdx.x >> 3), v = blockIdx.z;
  if (x < width && y < height && v < count) EXPOSE(v, x, y)
}
#else
extern "C" void render(PARAMETERS) {
  for (int v = 0; v < count; v++)
    for (int y = 0; y < height; y++)
      for (int x = 0; x < width; x++) EXPOSE(v, x, y)
}
#endif
