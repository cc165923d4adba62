// Implements the separable pixel filter k: its weight, its sampler, and the filtered adjoint.
//
// A pixel is I = ∫ k(x − c) L(x) dx with ∫ k = 1. The forward pass samples x − c in proportion to k and takes the mean.
// The backward pass needs the filtered adjoint Ã(x) = Σ_pixels k(x − c) A.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "core/channels.h"
#include "core/math.h"
#include "scene/scene.h"

namespace edgegrad {

enum class FilterKind { box, tent, gaussian };

class Filter {
   public:
    explicit Filter(FilterKind kind) : kind_(kind) {}

    // Returns half the width of the support, in pixels.
    double radius() const { return kind_ == FilterKind::box ? 0.5 : kind_ == FilterKind::tent ? 1.0 : 1.5; }

    // Returns the density at the offset d from the pixel's centre, along one axis.
    double weight(double d) const {
        d = std::fabs(d);
        if (d > radius()) return 0;
        if (kind_ == FilterKind::box) return 1;
        if (kind_ == FilterKind::tent) return 1 - d;
        return std::exp(-d * d / (2 * sigma * sigma)) / (inside * std::sqrt(2 * M_PI) * sigma);
    }

    // Returns an offset for u uniform in (0, 1), by the inverse of the cumulative weight.
    double sample(double u) const {
        if (kind_ == FilterKind::box) return u - 0.5;
        if (kind_ == FilterKind::tent) return u < 0.5 ? std::sqrt(2 * u) - 1 : 1 - std::sqrt(2 - 2 * u);
        // The Gaussian uses Winitzki's (2008) closed form of erf⁻¹ (2 · 10⁻³), then Newton steps on erf itself (10⁻¹⁴).
        const double y = (2 * u - 1) * inside, a = 0.147;
        const double l = std::log1p(-y * y), h = 2 / (M_PI * a) + 0.5 * l;
        // fmax guards against rounding at y ≈ 0.
        double z = std::copysign(std::sqrt(std::fmax(0.0, std::sqrt(h * h - l / a) - h)), y);
        for (int i = 0; i < 3; ++i) z -= (std::erf(z) - y) * 0.5 * std::sqrt(M_PI) * std::exp(z * z);
        return std::clamp(z * std::sqrt(2.0) * sigma, -1.5, 1.5);
    }

    // Does the same for n numbers in place.
    void sample(int n, double* u) const {
        if (kind_ == FilterKind::box)
            for (int i = 0; i < n; ++i) u[i] -= 0.5;
        else
            for (int i = 0; i < n; ++i) u[i] = sample(u[i]);
    }

    bool is_box() const { return kind_ == FilterKind::box; }

   private:
    static constexpr double sigma = 0.5;                   // px
    static constexpr double inside = 0.99730020393673979;  // part of a Gaussian within 3 σ: erf(3 / √2)
    FilterKind kind_;
};

struct ImageOptions {
    int spp;  // number of samples per pixel
    Filter filter;
    uint64_t seed;
};

// Applies the filter to the pixels of an image.
class FilteredPixels {
   public:
    FilteredPixels(Filter filter, int width, int height) : filter_(filter), width_(width), height_(height) {}

    // Calls visit(pixel, k(x − c)) for the pixels whose filter reaches x.
    template <class Visit>
    void around(Vec2 x, Visit visit) const {
        const double r = filter_.radius();
        // These pixels have a centre within r. The box takes floor(x) alone, so that a point on a border counts once.
        const bool box = filter_.is_box();
        const int i0 = std::max(0, int(box ? std::floor(x.x) : std::ceil(x.x - r - 0.5)));
        const int j0 = std::max(0, int(box ? std::floor(x.y) : std::ceil(x.y - r - 0.5)));
        const int i1 = std::min(width_ - 1, int(std::floor(box ? x.x : x.x + r - 0.5)));
        const int j1 = std::min(height_ - 1, int(std::floor(box ? x.y : x.y + r - 0.5)));
        for (int j = j0; j <= j1; ++j) {
            const double wy = filter_.weight(x.y - j - 0.5);
            for (int i = i0; i <= i1; ++i)
                visit(int64_t(j) * width_ + i, box ? 1.0 : wy * filter_.weight(x.x - i - 0.5));
        }
    }

   private:
    Filter filter_;
    int width_, height_;
};

// Filters the adjoint image. T is the type of images.
template <class T>
class FilteredAdjoint {
   public:
    FilteredAdjoint(const T* adjoint, const SceneView<T>& scene, Filter filter, int width, int height)
        : A_(adjoint), scene_(scene), pixels_(filter, width, height) {}

    // Returns A of a pixel, C numbers.
    const T* of(int64_t pixel) const { return A_ + pixel * scene_.channels; }

    // Calls visit(A, k) for the pixels that make up Ã(x) = Σ k A, where A has C numbers.
    template <class Visit>
    void around(Vec2 x, Visit visit) const {
        pixels_.around(x, [&](int64_t pixel, double weight) { visit(of(pixel), weight); });
    }

    // Writes Ã(x), C numbers. Returns false where it is zero in all channels.
    template <int N>
    bool at(Vec2 x, double* out) const {
        const int C = N ? all_channels<N> : scene_.channels;
        for (int c = 0; c < C; ++c) out[c] = 0;
        pixels_.around(x, [&](int64_t pixel, double weight) {
            const T* A = A_ + pixel * C;
            for (int c = 0; c < C; ++c) out[c] += weight * A[c];
        });
        bool any = false;
        for (int c = 0; c < C; ++c) any |= out[c] != 0;
        return any;
    }

    // Returns Σ_pixels k(x − c) A · background, the contribution of the background at x. Each pixel has its own
    // background, so this is not Ã(x) times something.
    template <int N>
    double times_background(Vec2 x) const {
        const int C = N ? all_channels<N> : scene_.channels;
        double sum = 0;
        pixels_.around(x, [&](int64_t pixel, double weight) {
            const T *A = A_ + pixel * C, *B = scene_.background_at(pixel);
            double product = 0;
            for (int c = 0; c < C; ++c) product += double(A[c]) * B[c];
            sum += weight * product;
        });
        return sum;
    }

   private:
    const T* A_;
    const SceneView<T>& scene_;
    FilteredPixels pixels_;
};

}  // namespace edgegrad
