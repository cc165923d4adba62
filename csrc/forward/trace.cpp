#include "forward/trace.h"

#include <algorithm>
#include <cmath>

#include "shading/cut_outs.h"

namespace edgegrad {

namespace {

Vec3 vec(const double* v) { return {v[0], v[1], v[2]}; }

template <class T>
Vec3 corner(const SceneView<T>& scene, int64_t face, int i) {
    return vec(scene.verts + 3 * int64_t(scene.faces[3 * face + i]));
}

// Where a ray meets the plane of a face: barycentrics, and the distance in lengths of its direction (Möller and
// Trumbore 1997). Not numbers where it runs along the plane.
struct Meeting {
    double u, v, t;

    bool exists() const { return std::isfinite(u + v + t); }
    // Within the face, as far as doubles can tell.
    bool inside() const {
        constexpr double rounding = 1e-12;
        return u >= -rounding && v >= -rounding && u + v <= 1 + rounding;
    }
};
template <class T>
Meeting meet(const SceneView<T>& scene, int64_t face, const Ray& ray) {
    const Vec3 q0 = corner(scene, face, 0), e1 = corner(scene, face, 1) - q0, e2 = corner(scene, face, 2) - q0,
               s = ray.origin - q0;
    const Vec3 p = cross(ray.direction, e2), q = cross(s, e1);
    const double scale = 1 / dot(e1, p);
    return {dot(s, p) * scale, dot(ray.direction, q) * scale, dot(e2, q) * scale};
}

// Casts n rays, each again and again without the faces that `accept(i, face)` refuses, until it accepts one or there is
// none: then `face` is −1. A ray begins without the face `own(i)`, if that is not negative.
template <class MakeRay, class Own, class Accept>
void cast_each(const RayCaster& caster, int n, int32_t* face, MakeRay make, Own own, Accept accept) {
    std::vector<int32_t> without[RayBatch::size];
    std::vector<int> open(n);
    for (int i = 0; i < n; ++i) {
        open[i] = i, face[i] = -1;
        if (own(i) >= 0) without[i].push_back(own(i));
    }
    RayBatch batch;
    RayCaster::Ignored ignored[RayBatch::size];
    while (!open.empty()) {
        batch.count = int(open.size());
        for (int k = 0; k < batch.count; ++k)
            batch.set(k, caster.frame(), make(open[k])), ignored[k] = without[open[k]];
        caster.cast(batch, ignored);
        std::vector<int> again;
        for (int k = 0; k < batch.count; ++k) {
            const int i = open[k];
            if (batch.face[k] < 0) continue;
            if (accept(i, batch.face[k])) {
                face[i] = batch.face[k];
                continue;
            }
            without[i].insert(std::upper_bound(without[i].begin(), without[i].end(), batch.face[k]), batch.face[k]);
            again.push_back(i);
        }
        open = std::move(again);
    }
}

template <class Body>
void each_batch(int64_t size, Team& team, Body body) {
    team.each_block(size, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t k = first; k < last; k += RayBatch::size) {
            team.check();
            body(k, int(std::min<int64_t>(RayBatch::size, last - k)));
        }
    });
}

}  // namespace

template <class T>
RayHits trace(const SceneView<T>& scene, const RayCaster& caster, const TracedRays& rays, Team& team) {
    RayHits out;
    out.face.resize(rays.size), out.b.resize(2 * rays.size);
    each_batch(rays.size, team, [&](int64_t first, int n) {
        const auto ray = [&](int i) {
            return Ray{vec(rays.origins + 3 * (first + i)), vec(rays.directions + 3 * (first + i))};
        };
        // At its rim a face may be hit in float that the ray misses by a rounding: then it is hit at the rim, for its
        // neighbour may be missed as well. One that the ray runs along shows nothing.
        cast_each(
            caster, n, out.face.data() + first, ray, [](int) { return -1; },
            [&](int i, int32_t face) {
                const Meeting m = meet(scene, face, ray(i));
                if (!m.exists() || m.t < 0) return false;
                double u = std::max(m.u, 0.0), v = std::max(m.v, 0.0);
                if (u + v > 1) u /= u + v, v = 1 - u;
                if (!shows(scene, face, {u, v})) return false;
                out.b[2 * (first + i)] = u, out.b[2 * (first + i) + 1] = v;
                return true;
            });
    });
    return out;
}

template <class T>
std::vector<uint8_t> visible(const SceneView<T>& scene, const RayCaster& caster, const Sightlines& lines, Team& team) {
    std::vector<uint8_t> out(lines.size);
    each_batch(lines.size, team, [&](int64_t first, int n) {
        Ray ray[RayBatch::size];
        double contact[RayBatch::size];
        for (int i = 0; i < n; ++i) {
            const int64_t k = first + i, face = lines.face[k];
            const double u = lines.b[2 * k], v = lines.b[2 * k + 1];
            const Vec3 from =
                (1 - u - v) * corner(scene, face, 0) + u * corner(scene, face, 1) + v * corner(scene, face, 2);
            ray[i] = {from, vec(lines.to + 3 * k) - from, 1};
            contact[i] = lines.contact[k] / length(ray[i].direction);
        }
        int32_t hidden_by[RayBatch::size];
        cast_each(
            caster, n, hidden_by, [&](int i) { return ray[i]; }, [&](int i) { return lines.face[first + i]; },
            [&](int i, int32_t face) {
                const Meeting m = meet(scene, face, ray[i]);
                return m.exists() && m.inside() && m.t > contact[i] && m.t < 1 - contact[i] &&
                       shows(scene, face, inside({m.u, m.v}));
            });
        for (int i = 0; i < n; ++i) out[first + i] = hidden_by[i] < 0;
    });
    return out;
}

template RayHits trace(const SceneView<float>&, const RayCaster&, const TracedRays&, Team&);
template RayHits trace(const SceneView<double>&, const RayCaster&, const TracedRays&, Team&);
template std::vector<uint8_t> visible(const SceneView<float>&, const RayCaster&, const Sightlines&, Team&);
template std::vector<uint8_t> visible(const SceneView<double>&, const RayCaster&, const Sightlines&, Team&);

}  // namespace edgegrad
