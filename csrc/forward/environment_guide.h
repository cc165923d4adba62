// Learns from which directions points of a scene see the environment. A few pilot paths measure it, before the others
// sample the environment.
//
// If only brightness guides the samples, most samples of an environment behind an opening are occluded. One pdf q for
// all points has the least variance at q ∝ L √E[V (n·l)²], with the radiance L and visibility V. The mean is taken over
// cells of directions. It affects only where samples are drawn; all directions stay possible.
#pragma once

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <vector>

#include "shading/lit/path.h"

namespace edgegrad {

class EnvironmentGuide {
   public:
    explicit EnvironmentGuide(const LitScene& lit) : lit_(lit) {
        for (size_t k = 0; k < lit.lights.size() && light_ < 0; ++k)
            if (lit.lights[k].kind == Light::Kind::environment && lit.lights[k].is_image) light_ = int(k);
    }

    bool has_environment() const { return light_ >= 0; }

    // Adds the visibility that the points of paths 0 … n − 1 found.
    void add(const Paths& paths, int64_t n) {
        const std::vector<LightSample>& lights = paths.lights();
        for (int64_t i = 0; i < n; ++i) {
            const Path path = paths.path(i);
            for (int k = i % paths_of_point ? 1 : 0; k < path.points; ++k)
                for (size_t j = 0; j < lights.size(); ++j)
                    if (lights[j].light == light_) add(path.drawn_at(k)[j], path.seen_at(k)[j], paths.surface(i, k).n);
        }
    }

    // Returns the scene with an environment whose pdf uses what was added; it refers to this object.
    LitScene guided() {
        const Light& light = lit_.lights[light_];
        double total_sum = 0, total = 0, mass = 0, before = 0;
        for (size_t c = 0; c < sum_.size(); ++c) total_sum += double(sum_[c]) / unit, total += double(count_[c]);
        LitScene out = lit_;
        if (!(total_sum > 0)) return out;
        const double mean = total_sum / total;
        pdf_.resize(light.size), running_.resize(light.size);
        for (int64_t t = 0; t < light.size; ++t) {
            const size_t c = cell(t);
            const double here = (double(sum_[c]) / unit + prior_points * mean) / (double(count_[c]) + prior_points);
            const double factor = std::sqrt(std::max(here, least_density * mean));
            mass += factor * (light.running[t] - before), before = light.running[t];
            running_[t] = mass, pdf_[t] = factor * light.pdf[t];
        }
        for (int64_t t = 0; t < light.size; ++t) running_[t] /= mass, pdf_[t] /= mass;
        out.lights[light_].running = running_.data(), out.lights[light_].pdf = pdf_.data();
        return out;
    }

   private:
    static constexpr int64_t rows = 12, columns = 24;
    static constexpr double prior_points = 4;      // This many points represent the mean of all.
    static constexpr double least_density = 0.02;  // relative to the mean
    static constexpr double unit = 1 << 20;

    size_t cell(int64_t texel) const {
        const Light& light = lit_.lights[light_];
        return size_t(texel / light.width * rows / light.height * columns +
                      texel % light.width * columns / light.width);
    }
    // Integer sums do not depend on their order.
    void add(const LightPoint& p, int8_t seen, Vec3 n) {
        if (seen == not_sampled) return;
        const double cosine = dot(n, place(lit_, lit_.lights[light_], p));
        const size_t c = cell(p.index);
        std::atomic_ref(count_[c]).fetch_add(1, std::memory_order_relaxed);
        if (seen > 0) std::atomic_ref(sum_[c]).fetch_add(int64_t(unit * cosine * cosine), std::memory_order_relaxed);
    }

    const LitScene& lit_;
    int light_ = -1;
    std::array<int64_t, rows * columns> sum_{}, count_{};
    std::vector<double> pdf_, running_;
};

}  // namespace edgegrad
