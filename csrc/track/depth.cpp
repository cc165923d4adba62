#include "track/depth.h"

#include <algorithm>
#include <cmath>

#include "track/texture.h"

namespace edgegrad {

using Settings = TrackSettings;

DepthTerm::DepthTerm(const TrackedMesh& mesh) : points_(mesh.surface) {
    chosen_.reserve(Settings::points), rows_.reserve(Settings::points), sizes_.reserve(Settings::points);
}

void DepthTerm::choose_visible(const Visibility& visibility, int object) {
    choose_visible_points(points_, visibility, object, batch_, chosen_);
}

void DepthTerm::add(const DepthView& depth, const TrackCamera& camera, const PosedMesh& object, NormalEquations& to) {
    rows_.clear(), sizes_.clear();
    const double size = object.mesh->size();
    for (const int32_t k : chosen_) {
        const Vec3 arm = object.pose.R * points_.X[k], q = arm + object.pose.c, N = object.pose.R * points_.normal[k];
        const auto x = camera.position(q);
        if (!x || !camera.contains(*x, 0)) continue;
        const int i = int(x->x), j = int(x->y);
        const float z = depth.z[int64_t(j) * depth.width + i];
        if (!(z > 0) || !std::isfinite(z)) continue;
        const auto ray = camera.ray({i + 0.5, j + 0.5});
        if (!ray) continue;
        const double along = dot(N, ray->direction), t = dot(N, q - ray->origin) / along;
        Row row;
        row.residual = z - (ray->origin.z + t * ray->direction.z);
        if (!std::isfinite(row.residual)) continue;
        step_gradient(arm, size, (ray->direction.z / along) * N, row.J);
        rows_.push_back(row), sizes_.push_back(std::fabs(row.residual));
    }
    explained_ = 0;
    if (rows_.empty()) return;
    const auto middle = sizes_.begin() + sizes_.size() / 2;
    std::nth_element(sizes_.begin(), middle, sizes_.end());
    const double deviation =
        std::clamp(1.4826 * *middle, Settings::depth_noise[0] * size, Settings::depth_noise[1] * size);
    for (const Row& row : rows_) {
        const double r = row.residual / deviation;
        const double surface =
            (1 - Settings::occluded) * std::exp(-0.5 * r * r) * size / (deviation * std::sqrt(2 * M_PI));
        const double share = surface / (surface + Settings::occluded);
        explained_ += share / double(rows_.size());
        to.add(row.J, row.residual, share / (deviation * deviation));
    }
}

}  // namespace edgegrad
