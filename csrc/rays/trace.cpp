#include "rays/trace.h"

#include <algorithm>
#include <cmath>

#include "rays/alpha_mask.h"
#include "rays/plane_hit.h"

namespace edgegrad {

namespace {

template <class Body>
void each_batch(int64_t size, ThreadTeam& team, Body body) {
    team.parallel_for_blocks(size, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t k = first; k < last; k += RayBatch::size) {
            team.check();
            body(k, int(std::min<int64_t>(RayBatch::size, last - k)));
        }
    });
}

template <class T>
Vec3 point_on(const SceneView<T>& scene, int64_t face, const double* b) {
    const double u = b[0], v = b[1];
    return (1 - u - v) * corner(scene, face, 0) + u * corner(scene, face, 1) + v * corner(scene, face, 2);
}

// Returns the hit moved onto the face. Float may hit a face at its border that the ray misses by a rounding; the border
// counts as hit, because the neighbour may be missed as well.
Barycentrics onto_face(const PlaneHit& m) {
    double u = std::max(m.u, 0.0), v = std::max(m.v, 0.0);
    if (u + v > 1) u /= u + v, v = 1 - u;
    return {u, v};
}

// Returns whether a distance exceeds `contact`, or `rounding` for faces that share a vertex. Few are so close that
// shares() is called.
template <class Shares>
bool lies_beyond(double t, double contact, double rounding, Shares shares) {
    return t > std::max(contact, rounding) || (t > std::min(contact, rounding) && t > (shares() ? rounding : contact));
}

double extent(Vec3 v) { return std::max({std::fabs(v.x), std::fabs(v.y), std::fabs(v.z)}); }

}  // namespace

template <class T>
RayHits trace(const SceneView<T>& scene, const RayCaster& caster, const TracedRays& rays, ThreadTeam& team) {
    RayHits out;
    out.face.resize(rays.size), out.b.resize(2 * rays.size);
    each_batch(rays.size, team, [&](int64_t first, int n) {
        const auto ray = [&](int i) {
            return Ray{vec(rays.origins + 3 * (first + i)), vec(rays.directions + 3 * (first + i))};
        };
        // A face that the ray runs along shows nothing.
        std::vector<int32_t> without[RayBatch::size];
        for (int i = 0; i < n && rays.ignored; ++i)
            if (rays.ignored[first + i] >= 0) without[i] = {rays.ignored[first + i]};
        cast_each(caster, n, out.face.data() + first, without, ray, [&](int i, int32_t face) {
            const PlaneHit m = intersect_plane(scene, face, ray(i));
            if (!m.exists() || m.t < 0) return false;
            const Barycentrics at = onto_face(m);
            if (!shows(scene, face, at)) return false;
            out.b[2 * (first + i)] = at.u, out.b[2 * (first + i) + 1] = at.v;
            return true;
        });
    });
    return out;
}

template <class T>
void test_visibility(const SceneView<T>& scene, const RayCaster& caster, const Sightlines& lines, uint8_t* out) {
    RayBatch batch;
    for (int64_t first = 0; first < lines.size; first += RayBatch::size) {
        batch.count = int(std::min<int64_t>(RayBatch::size, lines.size - first));
        Ray ray[RayBatch::size];
        double contact[RayBatch::size];
        for (int i = 0; i < batch.count; ++i) {
            const int64_t k = first + i;
            const Vec3 from = point_on(scene, lines.face[k], lines.b + 2 * k);
            ray[i] = {from, vec(lines.to + 3 * k) - from, 1};
            contact[i] = lines.contact[k] / length(ray[i].direction);
            batch.set(i, caster.frame(), ray[i]);
        }
        caster.cast_occluded_with_alpha_test(batch, [&](int i, int32_t face) {
            const int32_t own = lines.face[first + i];
            if (face == own) return false;
            const PlaneHit m = intersect_plane(scene, face, ray[i]);
            if (!(m.exists() && m.inside() && m.t < 1 - contact[i])) return false;
            // The position of faces that share a vertex with the point's own face is exact, however close they are.
            if (!lies_beyond(m.t, contact[i], PlaneHit::rounding, [&] { return share_vertex(scene, face, own); }))
                return false;
            return shows(scene, face, inside({m.u, m.v}));
        });
        for (int i = 0; i < batch.count; ++i) out[first + i] = !batch.hidden[i];
    }
}

template <class T>
std::vector<uint8_t> visible(const SceneView<T>& scene, const RayCaster& caster, const Sightlines& lines,
                             ThreadTeam& team) {
    std::vector<uint8_t> out(lines.size);
    each_batch(lines.size, team, [&](int64_t first, int n) {
        test_visibility(scene, caster,
                        {lines.face + first, lines.b + 2 * first, lines.to + 3 * first, lines.contact + first, n},
                        out.data() + first);
    });
    return out;
}

template <class T>
void trace_from_surface(const SceneView<T>& scene, const RayCaster& caster, const SurfaceRays& rays, int32_t* face,
                        double* b) {
    std::vector<int32_t> without[RayBatch::size];
    for (int64_t first = 0; first < rays.size; first += RayBatch::size) {
        const int n = int(std::min<int64_t>(RayBatch::size, rays.size - first));
        Ray ray[RayBatch::size];
        for (int i = 0; i < n; ++i) {
            const int64_t k = first + i, own = rays.face[k];
            ray[i] = {point_on(scene, own, rays.b + 2 * k), vec(rays.directions + 3 * k)};
            without[i] = {rays.face[k]};
        }
        cast_each(
            caster, n, face + first, without, [&](int i) { return ray[i]; },
            [&](int i, int32_t hit) {
                const int64_t k = first + i;
                const PlaneHit m = intersect_plane(scene, hit, ray[i]);
                // The position of faces that share a vertex is exact, as in test_visibility().
                if (!m.exists() || !lies_beyond(m.t, rays.contact[k], PlaneHit::rounding * extent(ray[i].origin),
                                                [&] { return share_vertex(scene, hit, rays.face[k]); }))
                    return false;
                const Barycentrics at = onto_face(m);
                if (!shows(scene, hit, at)) return false;
                b[2 * k] = at.u, b[2 * k + 1] = at.v;
                return true;
            });
    }
}

template void trace_from_surface(const SceneView<float>&, const RayCaster&, const SurfaceRays&, int32_t*, double*);
template void trace_from_surface(const SceneView<double>&, const RayCaster&, const SurfaceRays&, int32_t*, double*);
template RayHits trace(const SceneView<float>&, const RayCaster&, const TracedRays&, ThreadTeam&);
template RayHits trace(const SceneView<double>&, const RayCaster&, const TracedRays&, ThreadTeam&);
template void test_visibility(const SceneView<float>&, const RayCaster&, const Sightlines&, uint8_t*);
template void test_visibility(const SceneView<double>&, const RayCaster&, const Sightlines&, uint8_t*);
template std::vector<uint8_t> visible(const SceneView<float>&, const RayCaster&, const Sightlines&, ThreadTeam&);
template std::vector<uint8_t> visible(const SceneView<double>&, const RayCaster&, const Sightlines&, ThreadTeam&);

}  // namespace edgegrad
