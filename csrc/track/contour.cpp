#include "track/contour.h"

#include <algorithm>
#include <cmath>

namespace edgegrad {

namespace {

using Settings = TrackSettings;

constexpr double outside_of_contour =
    0.7;                      // px: less meets the object again by the rounding of floats, more meets others
constexpr double margin = 2;  // px from the image's border

}  // namespace

void Visibility::test(RayBatch& batch, int object, const Ray* rays, int n, uint8_t* hidden) const {
    const PosedMesh& o = objects_[object];
    batch.count = n;
    for (int i = 0; i < n; ++i)
        batch.set(i, o.mesh->caster().frame(),
                  {o.pose.to_mesh(rays[i].origin), o.pose.direction_to_mesh(rays[i].direction), rays[i].end});
    o.mesh->caster().cast_occluded(batch);
    for (int i = 0; i < n; ++i) hidden[i] |= batch.hidden[i];
}

void Visibility::test_others(RayBatch& batch, int object, const Ray* rays, int n, uint8_t* hidden) const {
    for (int o = 0; o < int(objects_.size()); ++o)
        if (o != object) test(batch, o, rays, n, hidden);
}

Ray Visibility::ray_to(Vec3 q) const {
    if (camera_.perspective()) return {{}, q, 1};
    double before = 0;
    for (const PosedMesh& o : objects_) before = std::max(before, q.z - o.pose.c.z + 2 * o.mesh->radius());
    return {{q.x, q.y, q.z - before}, {0, 0, before}, 1};
}

Contour::Contour(const TrackedMesh& mesh) : mesh_(mesh), orientation_(mesh.n_faces()) {
    pieces_.reserve(mesh.edges().size());
    sharp_.reserve(Settings::candidates);
    candidates_.reserve(Settings::candidates), points_.reserve(Settings::candidates),
        order_.reserve(Settings::candidates);
}

void Contour::find(const Visibility& visibility, int object, double phase, double reach, bool sharp) {
    const TrackCamera& camera = visibility.camera();
    const RigidPose& pose = visibility.objects()[object].pose;
    mesh_.find_orientations(camera, pose, orientation_.data());
    gather_edges(camera, pose, false);
    // Candidates are as many as gave enough visible points the last time, and some more.
    const int enough = int(1.15 * Settings::lines / std::max(outline_share_, 1e-3));
    const int count = std::clamp(enough, Settings::lines, Settings::candidates);
    spacing_ = pieces_.empty() ? 0 : pieces_.back().end / count;
    draw_candidates(camera, pose, phase, count);
    drop_hidden(visibility, object);
    find_crossings(reach);
    sharp_.clear();
    if (!sharp) return;
    gather_edges(camera, pose, true);
    if (pieces_.empty()) return;
    const double wanted = pieces_.back().end / std::max(spacing_, 2.0);
    draw_candidates(camera, pose, phase, int(std::min<double>(Settings::lines, wanted + 1)));
    keep_visible_sharp(visibility, object);
}

// Keeps the candidates that nothing hides. The surface itself begins at the point, but for the rounding of floats.
void Contour::keep_visible_sharp(const Visibility& visibility, int object) {
    const PosedMesh& o = visibility.objects()[object];
    for (size_t first = 0; first < candidates_.size(); first += RayBatch::size) {
        const int n = int(std::min<size_t>(RayBatch::size, candidates_.size() - first));
        Ray rays[RayBatch::size];
        uint8_t hidden[RayBatch::size] = {};
        for (int i = 0; i < n; ++i) {
            rays[i] = visibility.ray_to(o.pose(candidates_[first + i].X));
            rays[i].end = 1 - Settings::surface_depth * o.mesh->size() / length(rays[i].direction);
        }
        visibility.test(batch_, object, rays, n, hidden);
        visibility.test_others(batch_, object, rays, n, hidden);
        for (int i = 0; i < n; ++i)
            if (!hidden[i]) sharp_.push_back(candidates_[first + i]);
    }
}

void Contour::gather_edges(const TrackCamera& camera, const RigidPose& pose, bool sharp) {
    pieces_.clear();
    double end = 0;
    const auto edges = mesh_.edges();
    const int8_t* orientation = orientation_.data();
    const double w = camera.width(), h = camera.height();
    const auto add = [&](int32_t e) {
        const TrackedEdge& edge = edges[e];
        const auto a = camera.position(pose(mesh_.vertex(edge.a))), b = camera.position(pose(mesh_.vertex(edge.b)));
        if (!a || !b) return;
        if ((a->x < 0 && b->x < 0) || (a->y < 0 && b->y < 0) || (a->x > w && b->x > w) || (a->y > h && b->y > h))
            return;
        const double along = length(*b - *a);
        // An edge that is much longer than the image crosses the seam of a panorama, or passes close by the eye.
        if (!(along < 2 * (w + h))) return;
        end += along;
        pieces_.push_back({e, end});
    };
    const auto side = [&](const TrackedEdge& edge, int i) { return edge.side[i] * orientation[edge.face[i]]; };
    if (sharp) {
        for (const int32_t e : mesh_.sharp_edges())
            if (side(edges[e], 0) != side(edges[e], 1)) add(e);
        return;
    }
    for (size_t e = 0; e < edges.size(); ++e) {
        const int first = side(edges[e], 0);
        if (edges[e].face[1] >= 0 ? first == side(edges[e], 1) && first != 0 : first != 0) add(int32_t(e));
    }
}

void Contour::draw_candidates(const TrackCamera& camera, const RigidPose& pose, double phase, int count) {
    candidates_.clear();
    if (pieces_.empty()) return;
    const double total = pieces_.back().end;
    size_t k = 0;
    for (int i = 0; i < count; ++i) {
        const double at = (i + phase) / count * total;
        while (k + 1 < pieces_.size() && pieces_[k].end < at) ++k;
        const double begin = k ? pieces_[k - 1].end : 0, along = pieces_[k].end - begin;
        if (!(along > 0)) continue;
        const TrackedEdge& edge = mesh_.edges()[pieces_[k].edge];
        const double s = std::clamp((at - begin) / along, 0.0, 1.0);
        const Vec3 A = mesh_.vertex(edge.a), B = mesh_.vertex(edge.b), X = (1 - s) * A + s * B;
        const auto seen = camera.project(pose(X));
        if (!seen || !camera.contains(seen->x, margin)) continue;
        const Vec3 d = pose.R * (B - A);
        const Vec2 tangent{dot(seen->dx, d), dot(seen->dy, d)};
        const double size = length(tangent);
        if (!(size > 0)) continue;
        const double sign = edge.side[0] * orientation_[edge.face[0]] / size;  // of the side where the faces lie
        candidates_.push_back({X, seen->x, {sign * tangent.y, -sign * tangent.x}, 0, 0});
    }
    // Around their middle, so that successive rays are coherent, and a choice of every other point is even.
    Vec2 middle;
    for (const ContourPoint& p : candidates_) middle += 1.0 / double(candidates_.size()) * p.x;
    const auto angle = [&](const ContourPoint& p) {
        const Vec2 d = p.x - middle;
        const double s = d.y / (std::fabs(d.x) + std::fabs(d.y) + 1e-300);
        return d.x < 0 ? 2 - s : s;
    };
    std::sort(candidates_.begin(), candidates_.end(), [&](const ContourPoint& p, const ContourPoint& o) {
        const double a = angle(p), b = angle(o);
        return a != b ? a < b : p.x.x != o.x.x ? p.x.x < o.x.x : p.x.y < o.x.y;
    });
}

void Contour::drop_hidden(const Visibility& visibility, int object) {
    const TrackCamera& camera = visibility.camera();
    const RigidPose& pose = visibility.objects()[object].pose;
    points_.clear();
    int outline = 0;
    for (size_t first = 0; first < candidates_.size(); first += RayBatch::size) {
        const int n = int(std::min<size_t>(RayBatch::size, candidates_.size() - first));
        Ray rays[RayBatch::size];
        uint8_t own[RayBatch::size] = {}, covered[RayBatch::size] = {};
        for (int i = 0; i < n; ++i) {
            const ContourPoint& p = candidates_[first + i];
            const auto ray = camera.ray(p.x + outside_of_contour * p.n);
            const Vec3 q = pose(p.X);
            // The lens may end just outside.
            rays[i] = ray ? *ray : visibility.ray_to(q);
            own[i] = !ray;
            if (!camera.perspective()) rays[i].origin.z = visibility.ray_to(q).origin.z;
        }
        visibility.test(batch_, object, rays, n, own);
        for (int i = 0; i < n; ++i) {
            const Vec3 d = rays[i].direction;
            rays[i].end = dot(pose(candidates_[first + i].X) - rays[i].origin, d) / dot(d, d);
        }
        visibility.test_others(batch_, object, rays, n, covered);
        for (int i = 0; i < n; ++i) {
            outline += !own[i];
            if (!own[i] && !covered[i]) points_.push_back(candidates_[first + i]);
        }
    }
    outline_share_ = candidates_.empty() ? 0.5 : double(outline) / double(candidates_.size());
    visible_share_ = outline ? double(points_.size()) / outline : 0;
}

// A line meets the contour again where another point lies on it whose normal points elsewhere; a neighbour on the same
// side is no other border.
void Contour::find_crossings(double reach) {
    const int n = int(points_.size());
    const double near = std::max(1.5, spacing_), far = reach + near;
    order_.resize(n);
    for (int i = 0; i < n; ++i) order_[i] = i;
    std::sort(order_.begin(), order_.end(),
              [&](int i, int j) { return points_[i].x.x != points_[j].x.x ? points_[i].x.x < points_[j].x.x : i < j; });
    for (ContourPoint& p : points_) p.inside = p.outside = float(reach);
    const auto meet = [](ContourPoint& p, Vec2 d) {
        const float r = float(d.x * p.n.x + d.y * p.n.y);
        if (r > 1) p.outside = std::min(p.outside, r);
        if (r < -1) p.inside = std::min(p.inside, -r);
    };
    for (int a = 0; a < n; ++a) {
        ContourPoint& p = points_[order_[a]];
        for (int b = a + 1; b < n; ++b) {
            ContourPoint& o = points_[order_[b]];
            const Vec2 d = o.x - p.x;
            if (d.x > far) break;
            if (std::fabs(d.y) > far || p.n.x * o.n.x + p.n.y * o.n.y >= 0.3) continue;
            if (std::fabs(wedge(d, p.n)) < near) meet(p, d);
            if (std::fabs(wedge(d, o.n)) < near) meet(o, -1.0 * d);
        }
    }
    std::erase_if(points_, [](const ContourPoint& p) { return p.inside <= 2 || p.outside <= 2; });
    const int kept = int(points_.size());
    if (kept <= Settings::lines) return;
    for (int i = 0; i < Settings::lines; ++i) points_[i] = points_[int64_t(i) * (kept - 1) / (Settings::lines - 1)];
    points_.resize(Settings::lines);
}

}  // namespace edgegrad
