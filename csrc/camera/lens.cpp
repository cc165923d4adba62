#include "camera/lens.h"

#include <algorithm>
#include <limits>

#include "camera/radial_inverse.h"

namespace edgegrad {

namespace {

// Returns points on the circle |n| = r.
constexpr int angles = 16;
Vec2 on_circle(double r, int i) {
    const double a = 2 * M_PI * i / angles;
    return {r * std::cos(a), r * std::sin(a)};
}

// Returns the least det ∂m/∂n on the circle. NaN counts as a fold.
template <RadialLens L>
double least_area_scale(const L& lens, double r) {
    double least = std::numeric_limits<double>::infinity();
    for (int i = 0; i < angles; ++i) {
        const double det = determinant(lens.jacobian(on_circle(r, i)));
        if (!(det > 0)) return 0;
        least = std::min(least, det);
    }
    return least;
}

// Returns r in [0, fold] with lens.radius(r) = m, or the fold. Newton steps are bisected where they leave the bracket.
template <RadialLens L>
double undistorted_radius(const L& lens, double fold, double m) {
    double low = 0, high = fold, r = std::min(m, fold);
    for (int i = 0; i < 64; ++i) {
        const double error = lens.radius(r) - m;
        if (error == 0) return r;  // Otherwise the loop would bisect a bracket that ends there.
        (error < 0 ? low : high) = r;
        const double next = r - error / lens.radius_slope(r);
        const double step = next > low && next < high ? next : 0.5 * (low + high);
        if (std::fabs(step - r) <= 1e-12 * (1 + r)) return step;
        r = step;
    }
    return r;
}

// Returns the solution without the part that is not radial.
template <RadialLens L>
Vec2 undistort_radial(const L& lens, const LensDisc& disc, Vec2 m) {
    Vec2 n = m;
    if (disc.inverse && disc.inverse->undistort(1, &n.x, &n.y)) return n;
    const double size = length(m);
    return size > 0 ? (undistorted_radius(lens, disc.fold, size) / size) * m : m;
}

// Refines it by Newton steps.
template <RadialLens L>
std::optional<Vec2> undistort(const L& lens, const LensDisc& disc, Vec2 m) {
    const double size = length(m);
    if (size > disc.reach) return {};
    if (size == 0 && length(lens.distort(m)) == 0) return m;
    Vec2 n = undistort_radial(lens, disc, m);
    for (int i = 0; i < 32; ++i) {
        const Vec2 step = solve(lens.jacobian(n), m - lens.distort(n));
        if (!std::isfinite(step.x + step.y)) return {};
        // Near the fold a step may lead far away.
        const double far = length(step), most = 0.25 * (1 + length(n));
        n += std::min(1.0, most / std::max(far, 1e-300)) * step;
        if (far <= 1e-14 * (1 + length(n))) break;
    }
    // Otherwise the point lies on the fold, where it is seen infinitely small.
    if (!(length(lens.distort(n) - m) <= 1e-10 * (1 + size)) || !(length(n) < disc.fold)) return {};
    return n;
}

// Holds points of one pixel: where they are seen, m, and where they come from, n.
struct Points {
    static constexpr int size = 64;
    int count = 0;
    double m_x[size], m_y[size], n_x[size], n_y[size], error[size];
};

// Takes a step n + J⁻¹ (m − distort(n)) for all points, with J at the pixel's centre. J changes by at most a hundredth
// over a pixel, and each error shrinks by that factor. Returns whether all errors were small before the step, which
// leaves a hundredth of the last one.
constexpr double small_error = 1e-10;
template <RadialLens L>
[[gnu::always_inline]] inline bool chord_step(const L lens, const Mat2 inverse, Points& p) {
    for (int i = 0; i < p.count; ++i) {
        const Vec2 m = lens.distort({p.n_x[i], p.n_y[i]}), error{p.m_x[i] - m.x, p.m_y[i] - m.y},
                   step = inverse * error;
        p.n_x[i] += step.x, p.n_y[i] += step.y;
        p.error[i] = std::fabs(error.x) + std::fabs(error.y);
    }
    int64_t large = 0;
    for (int i = 0; i < p.count; ++i) large |= int64_t(!(p.error[i] < small_error));
    return !large;
}

EDGEGRAD_VECTORIZED bool chord_step(const AnyLens& lens, Mat2 inverse, Points& p) {
    if (const auto* l = std::get_if<BrownConrady>(&lens)) return chord_step(*l, inverse, p);
    return chord_step(*std::get_if<Fisheye>(&lens), inverse, p);
}

double radius_of_fold(const AnyLens& lens) {
    return with_radial_lens(lens, [](const auto& l) {
        // Radii are at equal angles, and geometric below the first of these, because a telephoto lens may fold at a
        // thousandth. Others lie between the turning radii of the radial part, however close these are.
        constexpr int radii = 256, small_radii = 96;
        const double step = std::atan(greatest_radius) / radii;
        std::vector<double> tested = l.turning_radii(greatest_radius);
        std::sort(tested.begin(), tested.end());
        for (size_t i = 1; i < tested.size(); ++i) tested[i - 1] = 0.5 * (tested[i - 1] + tested[i]);
        for (int i = 1 - small_radii; i <= radii; ++i)
            tested.push_back(i > 0 ? std::tan(i * step) : std::tan(step) * std::pow(1.1, i - 1));
        std::sort(tested.begin(), tested.end());
        double low = 0;
        for (double high : tested) {
            if (least_area_scale(l, high) > 0) {
                low = high;
                continue;
            }
            for (int j = 0; j < 40; ++j) {
                const double middle = 0.5 * (low + high);
                (least_area_scale(l, middle) > 0 ? low : high) = middle;
            }
            return low;
        }
        return greatest_radius;
    });
}

}  // namespace

// The lens maps the disc one to one, so the boundary of the disc's image is the image of its boundary. A hundredth
// allows for what lies between the points.
LensDisc disc_of(const AnyLens& lens) {
    LensDisc disc{radius_of_fold(lens), 0};
    constexpr int points = 64;
    for (int i = 0; i < points; ++i) {
        const double a = 2 * M_PI * i / points;
        const Vec2 n{disc.fold * std::cos(a), disc.fold * std::sin(a)};
        disc.reach =
            std::max(disc.reach, 1.01 * length(with_radial_lens(lens, [&](const auto& l) { return l.distort(n); })));
    }
    return disc;
}

Vec2 folding_place(const BrownConrady& lens, const LensDisc& disc) {
    const auto area_scale = [&](int i) { return determinant(lens.jacobian(on_circle(disc.fold, i))); };
    int least = 0;
    for (int i = 1; i < angles; ++i)
        if (area_scale(i) < area_scale(least)) least = i;
    return on_circle(disc.fold, least);
}

double undistorted_radius(const AnyLens& lens, double fold, double m) {
    return with_radial_lens(lens, [&](const auto& l) { return undistorted_radius(l, fold, m); });
}

std::optional<Vec2> undistort(const AnyLens& lens, const LensDisc& disc, Vec2 m) {
    if (has_cube_faces(lens))
        return with_cube_face_lens(lens, std::optional<Vec2>(), [&](const auto& l) { return l.undistort(m); });
    return with_radial_lens(lens, [&](const auto& l) { return undistort(l, disc, m); });
}

namespace {

// Returns false unless the lens is radial and its table holds all of the points.
bool undistort_by_table(const AnyLens& lens, const LensDisc& disc, int k, double* x, double* y) {
    if (!disc.inverse || k > Points::size || !with_radial_lens(lens, [](const auto& l) { return l.is_radial(); }))
        return false;
    double n_x[Points::size], n_y[Points::size];
    std::copy(x, x + k, n_x), std::copy(y, y + k, n_y);
    if (!disc.inverse->undistort(k, n_x, n_y)) return false;
    std::copy(n_x, n_x + k, x), std::copy(n_y, n_y + k, y);
    return true;
}

}  // namespace

void undistort_near(const AnyLens& lens, const LensDisc& disc, Vec2 m0, int k, double* x, double* y) {
    constexpr double nan = std::numeric_limits<double>::quiet_NaN();
    if (const auto* panorama = std::get_if<Equirectangular>(&lens)) return panorama->undistort_near(m0, k, x, y);
    if (const auto* fisheye = std::get_if<WideFisheye>(&lens)) {
        for (int i = 0; i < k; ++i) {
            const Vec2 n = fisheye->undistort({x[i], y[i]}).value_or(Vec2{nan, nan});
            x[i] = n.x, y[i] = n.y;
        }
        return;
    }
    if (undistort_by_table(lens, disc, k, x, y)) return;
    const std::optional<Vec2> n0 = undistort(lens, disc, m0);
    const Mat2 inverse =
        edgegrad::inverse(with_radial_lens(lens, [&](const auto& l) { return l.jacobian(n0.value_or(Vec2{})); }));
    constexpr int most_steps = 12;
    Points p;
    for (int first = 0; first < k; first += Points::size) {
        p.count = std::min(Points::size, k - first);
        std::copy(x + first, x + first + p.count, p.m_x), std::copy(y + first, y + first + p.count, p.m_y);
        std::fill(p.error, p.error + p.count, 1.0);
        if (n0) {
            for (int i = 0; i < p.count; ++i) {
                const Vec2 n = *n0 + inverse * (Vec2{p.m_x[i], p.m_y[i]} - m0);
                p.n_x[i] = n.x, p.n_y[i] = n.y;
            }
            for (int i = 0; i < most_steps && !chord_step(lens, inverse, p);) ++i;
        }
        for (int i = 0; i < p.count; ++i) {
            Vec2 n{p.n_x[i], p.n_y[i]};
            if (!(p.error[i] < small_error && length(n) < disc.fold)) {
                n = undistort(lens, disc, {p.m_x[i], p.m_y[i]}).value_or(Vec2{nan, nan});
            }
            x[first + i] = n.x, y[first + i] = n.y;
        }
    }
}

}  // namespace edgegrad
