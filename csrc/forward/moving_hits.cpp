#include "forward/moving_hits.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "accumulate/scatter.h"
#include "core/dual.h"

namespace edgegrad {

namespace {

template <class S>
S number(const double* value, const double* tangent, int64_t i) {
    if constexpr (std::is_same_v<S, double>) return value[i];
    else return {value[i], tangent ? tangent[i] : 0};
}
template <class S>
Vector<S> row(const double* value, const double* tangent, int64_t i) {
    return vector(number<S>(value, tangent, 3 * i), number<S>(value, tangent, 3 * i + 1),
                  number<S>(value, tangent, 3 * i + 2));
}

// Holds the rotation and translation of world_to_camera.
template <class S>
struct Pose {
    Vector<S> R[3];
    Vector<S> t;

    Pose(const double* value, const double* tangent) {
        for (int i = 0; i < 3; ++i)
            R[i] = vector(number<S>(value, tangent, 4 * i), number<S>(value, tangent, 4 * i + 1),
                          number<S>(value, tangent, 4 * i + 2));
        t = vector(number<S>(value, tangent, 3), number<S>(value, tangent, 7), number<S>(value, tangent, 11));
    }
    Vector<S> in_camera(Vector<S> p) const { return vector(dot(R[0], p), dot(R[1], p), dot(R[2], p)) + t; }
};

// Intersects a ray and a face in camera coordinates (Möller and Trumbore 1997).
template <class S>
struct PlaneIntersection {
    Vector<S> e1, e2, s, d, p, q;
    S scale, u, v;

    PlaneIntersection(const Vector<S>* corner, Vector<S> along, bool perspective) {
        e1 = corner[1] - corner[0], e2 = corner[2] - corner[0];
        s = perspective ? -1.0 * corner[0] : along - corner[0];
        d = perspective ? along : Vector<S>(Vec3{0, 0, 1});
        p = cross(d, e2), q = cross(s, e1);
        scale = S(1) / dot(e1, p);
        u = dot(s, p) * scale, v = dot(d, q) * scale;
    }
    bool exists() const { return std::isfinite(plain(u) + plain(v)); }
};
// Adds to the cotangents of the corners, and returns the cotangent of `along`.
Vec3 plane_intersection_vjp(const PlaneIntersection<double>& c, bool perspective, const double* b_bar,
                            Vec3* corner_bar) {
    const double u_bar = b_bar[1] - b_bar[0], v_bar = b_bar[2] - b_bar[0];
    Vec3 e1_bar, e2_bar, s_bar, d_bar, p_bar, q_bar;
    dot_vjp(c.s, c.p, u_bar * c.scale, s_bar, p_bar);
    dot_vjp(c.d, c.q, v_bar * c.scale, d_bar, q_bar);
    dot_vjp(c.e1, c.p, -(u_bar * c.u + v_bar * c.v) * c.scale, e1_bar, p_bar);
    cross_vjp(c.s, c.e1, q_bar, s_bar, e1_bar);
    cross_vjp(c.d, c.e2, p_bar, d_bar, e2_bar);
    corner_bar[0] -= e1_bar + e2_bar + s_bar, corner_bar[1] += e1_bar, corner_bar[2] += e2_bar;
    return perspective ? d_bar : s_bar;
}

// Holds a face in world and in camera coordinates.
template <class S>
struct FaceCorners {
    Vector<S> world[3], corner[3];

    FaceCorners(const MovingHits& hits, const Pose<S>& pose, const MovingArrays<const double>& at,
                const MovingArrays<const double>& tangents, int64_t i) {
        const int32_t* v = hits.faces + 3 * hits.face[i];
        for (int k = 0; k < 3; ++k)
            world[k] = row<S>(at.verts, tangents.verts, v[k]), corner[k] = pose.in_camera(world[k]);
    }
};
// Calls body(index of the ray, intersection) for all rays of hits.
template <class S, class Body>
void each_intersection(const MovingHits& hits, const Pose<S>& pose, const MovingArrays<const double>& at,
                       const MovingArrays<const double>& tangents, int64_t first, int64_t last, Body body) {
    for (int64_t i = first; i < last; ++i) {
        const FaceCorners<S> face(hits, pose, at, tangents, i);
        for (int64_t r = i * hits.rays; r < (i + 1) * hits.rays; ++r)
            body(r, PlaneIntersection<S>(face.corner, row<S>(at.along, tangents.along, r), hits.perspective));
    }
}

// Holds the gradients of one chunk of hits.
struct ChunkOfHits {
    RowBuffer verts;
    double pose[12] = {};  // R in rows, then t
};

}  // namespace

void intersect_planes(const MovingHits& hits, const MovingArrays<const double>& at, double* b, ThreadTeam& team) {
    const Pose<double> pose(at.world_to_camera, nullptr);
    team.parallel_for_blocks(hits.size, [&](int64_t, int64_t first, int64_t last) {
        each_intersection<double>(hits, pose, at, {}, first, last, [&](int64_t r, const PlaneIntersection<double>& c) {
            const bool there = c.exists();
            b[3 * r] = there ? 1 - c.u - c.v : 1, b[3 * r + 1] = there ? c.u : 0, b[3 * r + 2] = there ? c.v : 0;
        });
    });
}

void intersect_planes_vjp(const MovingHits& hits, const MovingArrays<const double>& at, const double* b_bar,
                          const MovingArrays<double>& to, ThreadTeam& team) {
    const Pose<double> pose(at.world_to_camera, nullptr);
    std::vector<ChunkOfHits> chunks;
    double seconds[2] = {};
    scatter_in_waves(
        team, hits.size, chunks,
        [&](ChunkOfHits& chunk, int owners) {
            if (to.verts) chunk.verts.prepare(3, owners);
            chunk.verts.clear();
            std::fill(chunk.pose, chunk.pose + 12, 0.0);
        },
        [&](int64_t first, int64_t last, ChunkOfHits& chunk) {
            for (int64_t i = first; i < last; ++i) {
                const FaceCorners<double> face(hits, pose, at, {}, i);
                Vec3 corner_bar[3];
                bool met = false;
                for (int64_t r = i * hits.rays; r < (i + 1) * hits.rays; ++r) {
                    const PlaneIntersection<double> c(face.corner, row<double>(at.along, nullptr, r), hits.perspective);
                    if (!c.exists()) continue;
                    met = true;
                    const Vec3 along = plane_intersection_vjp(c, hits.perspective, b_bar + 3 * r, corner_bar);
                    if (to.along)
                        to.along[3 * r] = along.x, to.along[3 * r + 1] = along.y, to.along[3 * r + 2] = along.z;
                }
                for (int k = 0; met && k < 3; ++k) {
                    const double bar[3] = {corner_bar[k].x, corner_bar[k].y, corner_bar[k].z};
                    const double p[3] = {face.world[k].x, face.world[k].y, face.world[k].z};
                    for (int r = 0; to.world_to_camera && r < 3; ++r) {
                        for (int s = 0; s < 3; ++s) chunk.pose[3 * r + s] += bar[r] * p[s];
                        chunk.pose[9 + r] += bar[r];
                    }
                    if (!to.verts) continue;
                    const Vec3 world_bar = bar[0] * pose.R[0] + bar[1] * pose.R[1] + bar[2] * pose.R[2];
                    const double row_bar[3] = {world_bar.x, world_bar.y, world_bar.z};
                    chunk.verts.add<3>(hits.faces[3 * hits.face[i] + k], row_bar);
                }
            }
        },
        [&](const ChunkOfHits& chunk, int owner) {
            if (to.verts) chunk.verts.add_to(to.verts, owner);
        },
        [&](const ChunkOfHits& chunk) {
            if (!to.world_to_camera) return;
            for (int r = 0; r < 3; ++r) {
                for (int s = 0; s < 3; ++s) to.world_to_camera[4 * r + s] += chunk.pose[3 * r + s];
                to.world_to_camera[4 * r + 3] += chunk.pose[9 + r];
            }
        },
        seconds);
}

void intersect_planes_jvp(const MovingHits& hits, const MovingArrays<const double>& at,
                          const MovingArrays<const double>& tangents, double* b_dot, ThreadTeam& team) {
    const Pose<Dual> pose(at.world_to_camera, tangents.world_to_camera);
    team.parallel_for_blocks(hits.size, [&](int64_t, int64_t first, int64_t last) {
        each_intersection<Dual>(hits, pose, at, tangents, first, last,
                                [&](int64_t r, const PlaneIntersection<Dual>& c) {
                                    const double u = c.exists() ? c.u.dot : 0, v = c.exists() ? c.v.dot : 0;
                                    b_dot[3 * r] = -u - v, b_dot[3 * r + 1] = u, b_dot[3 * r + 2] = v;
                                });
    });
}

void form_vjp(const LinearForm& form, const double* bar, double* table_bar, ThreadTeam& team) {
    // Each thread owns runs of rows, and adds to them in order. The sums are thus the same for any number of threads.
    constexpr int64_t run = 64;
    const int owners = team.threads();
    team.parallel_for(owners, [&](int64_t owner) {
        for (int64_t i = 0; i < form.size; ++i) {
            if ((form.row[i] / run) % owners != owner) continue;
            const double weight = bar[form.sample[i]];
            double* to = table_bar + form.row[i] * form.width;
            for (int64_t k = 0; k < form.width; ++k) to[k] += form.by[i * form.width + k] * weight;
        }
    });
}

}  // namespace edgegrad
