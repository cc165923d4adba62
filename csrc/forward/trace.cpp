#include "forward/trace.h"

#include <algorithm>
#include <cmath>

#include "rays/meeting.h"
#include "shading/cut_outs.h"

namespace edgegrad {

namespace {

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
        std::vector<int32_t> without[RayBatch::size];
        for (int i = 0; i < n && rays.ignored; ++i)
            if (rays.ignored[first + i] >= 0) without[i] = {rays.ignored[first + i]};
        cast_each(caster, n, out.face.data() + first, without, ray, [&](int i, int32_t face) {
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
void see(const SceneView<T>& scene, const RayCaster& caster, const Sightlines& lines, uint8_t* out) {
    RayBatch batch;
    for (int64_t first = 0; first < lines.size; first += RayBatch::size) {
        batch.count = int(std::min<int64_t>(RayBatch::size, lines.size - first));
        Ray ray[RayBatch::size];
        double contact[RayBatch::size];
        for (int i = 0; i < batch.count; ++i) {
            const int64_t k = first + i, face = lines.face[k];
            const double u = lines.b[2 * k], v = lines.b[2 * k + 1];
            const Vec3 from =
                (1 - u - v) * corner(scene, face, 0) + u * corner(scene, face, 1) + v * corner(scene, face, 2);
            ray[i] = {from, vec(lines.to + 3 * k) - from, 1};
            contact[i] = lines.contact[k] / length(ray[i].direction);
            batch.set(i, caster.frame(), ray[i]);
        }
        caster.cast_occluded_through(batch, [&](int i, int32_t face) {
            const int32_t own = lines.face[first + i];
            if (face == own) return false;
            const Meeting m = meet(scene, face, ray[i]);
            // How faces that share a vertex with the point's own lie to it is exact, however near they are.
            const double nearest = share_vertex(scene, face, own) ? Meeting::rounding : contact[i];
            return m.exists() && m.inside() && m.t > nearest && m.t < 1 - contact[i] &&
                   shows(scene, face, inside({m.u, m.v}));
        });
        for (int i = 0; i < batch.count; ++i) out[first + i] = !batch.hidden[i];
    }
}

template <class T>
std::vector<uint8_t> visible(const SceneView<T>& scene, const RayCaster& caster, const Sightlines& lines, Team& team) {
    std::vector<uint8_t> out(lines.size);
    each_batch(lines.size, team, [&](int64_t first, int n) {
        see(scene, caster, {lines.face + first, lines.b + 2 * first, lines.to + 3 * first, lines.contact + first, n},
            out.data() + first);
    });
    return out;
}

template RayHits trace(const SceneView<float>&, const RayCaster&, const TracedRays&, Team&);
template RayHits trace(const SceneView<double>&, const RayCaster&, const TracedRays&, Team&);
template void see(const SceneView<float>&, const RayCaster&, const Sightlines&, uint8_t*);
template void see(const SceneView<double>&, const RayCaster&, const Sightlines&, uint8_t*);
template std::vector<uint8_t> visible(const SceneView<float>&, const RayCaster&, const Sightlines&, Team&);
template std::vector<uint8_t> visible(const SceneView<double>&, const RayCaster&, const Sightlines&, Team&);

}  // namespace edgegrad
