// What a lens does to the straight image of a pinhole: it bends normalised image coordinates n to m, and K takes m to
// pixels. What is straight in n is a curve in m; an area grows by det ∂m/∂n. So all that is made of straight lines
// (faces, edges, the view volume) is worked on in the straight image, K n, and samples alone are bent.
#pragma once

#include <cmath>
#include <concepts>
#include <limits>
#include <optional>
#include <variant>
#include <vector>

#include "camera/brown_conrady.h"
#include "camera/equirectangular.h"
#include "camera/fisheye.h"
#include "core/math.h"

namespace edgegrad {

// A pinhole.
struct StraightLens {};

template <class L>
concept Lens = requires(const L lens, Vec2 n, Vec2& n_bar, double* coefficients_bar) {
    { L::coefficients } -> std::convertible_to<int>;
    { lens.bend(n) } -> std::same_as<Vec2>;
    { lens.jacobian(n) } -> std::same_as<Mat2>;  // ∂m/∂n
    lens.bend_vjp(n, n, n_bar, coefficients_bar);
};
static_assert(Lens<Equirectangular>);

// One that is radial, nearly: |m| at |n| = r but for what is not, its derivative, and the radii up to a greatest at
// which one of these changes its sign.
template <class L>
concept RadialLens = Lens<L> && requires(const L lens, double r) {
    { lens.radius(r) } -> std::same_as<double>;
    { lens.radius_slope(r) } -> std::same_as<double>;
    { lens.turning_radii(r) } -> std::same_as<std::vector<double>>;
};
static_assert(RadialLens<BrownConrady> && RadialLens<Fisheye>);

// A new lens is a file of its own, and a place in this list.
using AnyLens = std::variant<StraightLens, BrownConrady, Fisheye, Equirectangular>;
constexpr int most_coefficients = 8;
static_assert(BrownConrady::coefficients <= most_coefficients && Fisheye::coefficients <= most_coefficients &&
              Equirectangular::coefficients <= most_coefficients);

// f(lens), of one that is nearly radial; of any that is not straight.
template <class F>
auto with_radial_lens(const AnyLens& lens, F f) {
    if (const auto* l = std::get_if<BrownConrady>(&lens)) return f(*l);
    return f(*std::get_if<Fisheye>(&lens));
}
template <class F>
auto with_lens(const AnyLens& lens, F f) {
    if (const auto* l = std::get_if<Equirectangular>(&lens)) return f(*l);
    return with_radial_lens(lens, f);
}

// The disc in which every m of a radial lens has one n: what lies beyond is not seen.
struct LensDisc {
    double fold = std::numeric_limits<double>::infinity();  // the least |n| with det ∂m/∂n ≤ 0; or greatest_radius
    double reach = fold;                                    // no |m| from within is greater
};
LensDisc disc_of(const AnyLens& lens);
constexpr double greatest_radius = 30;  // 88° from the axis

// The n in the disc that is bent to m; none if there is none.
std::optional<Vec2> straighten(const AnyLens& lens, const LensDisc& disc, Vec2 m);

// The same for k points near m0, in place; not numbers where there is none.
void straighten_near(const AnyLens& lens, const LensDisc& disc, Vec2 m0, int k, double* x, double* y);

}  // namespace edgegrad
