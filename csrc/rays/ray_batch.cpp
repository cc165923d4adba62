#include "rays/ray_batch.h"

#include <algorithm>
#include <limits>
#include <numeric>

#include "rays/embree_api.h"

namespace edgegrad {

using namespace embree;

template <int W>
RayPacket<W>::RayPacket() {
    std::fill(mask, mask + W, ~0u);
    std::fill(instance, instance + W, INVALID_GEOMETRY_ID);
    std::fill(instance_primitive, instance_primitive + W, INVALID_GEOMETRY_ID);
    std::iota(id, id + W, 0u);
}

RayBatch::RayBatch(int width) {
    if (width == 16) packets_.emplace<Packets<16>>();
}

void RayBatch::set(int i, const RayFrame& frame, const Ray& ray) {
    const double scale = length(ray.direction);
    const Vec3 d = (1 / scale) * ray.direction;
    Vec3 o = frame.position(ray.origin);
    double end = ray.end * scale / frame.unit;
    if (frame.is_far(o)) {
        const double start = std::max(0.0, frame.start(o, d));
        o += start * d, end -= start;
    }
    const auto write = [&](auto& packet, int k) {
        packet.origin_x[k] = float(o.x), packet.origin_y[k] = float(o.y), packet.origin_z[k] = float(o.z);
        packet.direction_x[k] = float(d.x), packet.direction_y[k] = float(d.y), packet.direction_z[k] = float(d.z);
        packet.t_far[k] = float(std::clamp(end, -1.0, double(std::numeric_limits<float>::max()))),
        packet.geometry[k] = INVALID_GEOMETRY_ID;
    };
    if (auto* wide = std::get_if<Packets<16>>(&packets_)) write((*wide)[i / 16], i % 16);
    else write(std::get<Packets<8>>(packets_)[i / 8], i % 8);
}

// Always inlined, so it is compiled for each processor of read_faces() below.
template <int W>
[[gnu::always_inline]] inline void RayBatch::read_faces(const Packets<W>& packets) {
    for (int k = 0; k < count; k += W) {
        const RayPacket<W>& p = packets[k / W];
        EDGEGRAD_ROLLED for (int i = 0; i < W; ++i) face[k + i] =
            p.geometry[i] == INVALID_GEOMETRY_ID ? -1 : int32_t(p.triangle[i]);
    }
}

EDGEGRAD_VECTORIZED void RayBatch::read_faces() {
    if (auto* wide = std::get_if<Packets<16>>(&packets_)) read_faces<16>(*wide);
    else read_faces<8>(std::get<Packets<8>>(packets_));
}

}  // namespace edgegrad
