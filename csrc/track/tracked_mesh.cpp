#include "track/tracked_mesh.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace edgegrad {

// Ranks points along the Morton curve of their box.
void SurfacePoints::find_ranks() {
    if (X.empty()) return;
    Vec3 low = X[0], high = X[0];
    for (const Vec3 v : X) {
        low = {std::min(low.x, v.x), std::min(low.y, v.y), std::min(low.z, v.z)};
        high = {std::max(high.x, v.x), std::max(high.y, v.y), std::max(high.z, v.z)};
    }
    const double side = std::max({high.x - low.x, high.y - low.y, high.z - low.z, 1e-300});
    std::vector<std::pair<uint64_t, int32_t>> order(X.size());
    for (size_t i = 0; i < X.size(); ++i) {
        const Vec3 at = (1023 / side) * (X[i] - low);
        const unsigned cell[3] = {unsigned(at.x), unsigned(at.y), unsigned(at.z)};
        uint64_t key = 0;
        for (int bit = 10; bit-- > 0;)
            for (const unsigned c : cell) key = key << 1 | (c >> bit & 1);
        order[i] = {key, int32_t(i)};
    }
    std::sort(order.begin(), order.end());
    rank.resize(X.size());
    for (size_t i = 0; i < order.size(); ++i) rank[order[i].second] = int32_t(i);
}

TrackedMesh::TrackedMesh(const int32_t* faces, int64_t n_faces, const double* verts, int64_t n_verts,
                         const Spacing& spacing, SurfacePoints textured_, SurfacePoints surface_, ThreadTeam& team)
    : textured(std::move(textured_)), surface(std::move(surface_)), verts_(verts, verts + 3 * n_verts) {
    GeometryWork work;
    geometry_ = acquire_geometry(faces, n_faces, verts, n_verts, spacing, {.topology = true}, team, work);
    for (auto& n : normal_) n.resize(n_faces);
    offset_.resize(n_faces);
    Vec3 low = vertex(faces[0]), high = low;
    radius_ = 0;
    for (int64_t f = 0; f < n_faces; ++f) {
        const Vec3 p[3] = {vertex(faces[3 * f]), vertex(faces[3 * f + 1]), vertex(faces[3 * f + 2])};
        const Vec3 N = cross(p[1] - p[0], p[2] - p[0]);
        normal_[0][f] = N.x, normal_[1][f] = N.y, normal_[2][f] = N.z, offset_[f] = dot(N, p[0]);
        for (const Vec3 v : p) {
            low = {std::min(low.x, v.x), std::min(low.y, v.y), std::min(low.z, v.z)};
            high = {std::max(high.x, v.x), std::max(high.y, v.y), std::max(high.z, v.z)};
            radius_ = std::max(radius_, length(v));
        }
    }
    size_ = length(high - low);
    const Topology& topology = geometry_->topology();
    for (int64_t e = 0; e < topology.n_edges(); ++e) {
        const auto halves = topology.half_edges(e);
        // More than two faces meet in pairs, of which the contour may pass between any.
        const size_t pairs = halves.size() > 2 ? halves.size() : 1;
        for (size_t i = 0; i < pairs; ++i) {
            TrackedEdge edge{};
            const HalfEdge &first = halves[i], *second = halves.size() > 1 ? &halves[(i + 1) % halves.size()] : nullptr;
            edge.a = faces[3 * int64_t(first.face) + first.first()];
            edge.b = faces[3 * int64_t(first.face) + first.second()];
            edge.face[0] = first.face, edge.face[1] = second ? second->face : -1;
            edge.side[0] = first.backwards ? -1 : 1, edge.side[1] = second && second->backwards ? -1 : 1;
            const Vec3 N[2] = {normal(first.face), normal(second ? second->face : first.face)};
            const double along = dot(N[0], N[1]) * (second && first.backwards == second->backwards ? -1 : 1);
            if (second && along < std::cos(M_PI / 6) * length(N[0]) * length(N[1]))
                sharp_edges_.push_back(int32_t(edges_.size()));
            edges_.push_back(edge);
        }
    }
    spread_centres();
}

void TrackedMesh::find_orientations(const TrackCamera& camera, const RigidPose& pose, int8_t* out) const {
    const int64_t n = n_faces();
    const double *x = normal_[0].data(), *y = normal_[1].data(), *z = normal_[2].data(), *d = offset_.data();
    // The image's orientation is that of K, too, which cameras may mirror.
    const double mirrored = camera.mirrors() ? -1 : 1;
    const Vec3 eye = camera.perspective() ? pose.to_mesh({}) : pose.direction_to_mesh({0, 0, 1});
    const double rounding = 1e-14;  // of the planes' doubles, relative to the terms
    if (camera.perspective()) {
        for (int64_t f = 0; f < n; ++f) {
            const double s = mirrored * (d[f] - x[f] * eye.x - y[f] * eye.y - z[f] * eye.z);
            out[f] = int8_t((s > rounding * std::fabs(d[f])) - (s < -rounding * std::fabs(d[f])));
        }
    } else {
        for (int64_t f = 0; f < n; ++f) {
            const double s = mirrored * (x[f] * eye.x + y[f] * eye.y + z[f] * eye.z);
            out[f] = int8_t((s > 0) - (s < 0));
        }
    }
}

// Takes one vertex after the other that is farthest from those before.
void TrackedMesh::spread_centres() {
    const int64_t n = int64_t(verts_.size()) / 3;
    std::vector<double> least(n, std::numeric_limits<double>::infinity());
    int64_t next = 0;
    while (!caster().uses(next)) ++next;
    for (int k = 0; k < TrackSettings::centres; ++k) {
        const Vec3 centre = vertex(int32_t(next));
        centres_.push_back(centre);
        double most = -1;
        for (int64_t v = 0; v < n; ++v) {
            if (!caster().uses(v)) continue;
            const Vec3 apart = vertex(int32_t(v)) - centre;
            least[v] = std::min(least[v], dot(apart, apart));
            if (least[v] > most) most = least[v], next = v;
        }
    }
}

}  // namespace edgegrad
