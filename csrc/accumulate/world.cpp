#include "accumulate/world.h"

#include <array>

namespace edgegrad {

void add_world(const Camera& sub_camera, const double* verts, const Array<double>& q_bar, ThreadTeam& team,
               const Gradients& grad) {
    const auto parts = team.map_blocks(q_bar.size() / 3, [&](int64_t first, int64_t last) {
        std::array<double, 12> sum{};
        for (int64_t v = first; v < last; ++v) {
            const double *q = q_bar.data() + 3 * v, *p = verts + 3 * v;
            if (q[0] == 0 && q[1] == 0 && q[2] == 0) continue;
            if (grad.verts) {
                const Vec3 p_bar = transposed_times(sub_camera.R, {q[0], q[1], q[2]});
                grad.verts[3 * v] += p_bar.x, grad.verts[3 * v + 1] += p_bar.y, grad.verts[3 * v + 2] += p_bar.z;
            }
            if (grad.world_to_camera)
                for (int i = 0; i < 3; ++i) {
                    for (int j = 0; j < 3; ++j) sum[4 * i + j] += q[i] * p[j];
                    sum[4 * i + 3] += q[i];
                }
        }
        return sum;
    });
    if (grad.world_to_camera)
        for (const auto& sum : parts)
            for (int j = 0; j < 4; ++j) {
                const double* column = sum.data() + j;
                const Vec3 m = transposed_times(sub_camera.rotation, {column[0], column[4], column[8]});
                double* to = grad.world_to_camera + j;
                to[0] += m.x, to[4] += m.y, to[8] += m.z;
            }
}

}  // namespace edgegrad
