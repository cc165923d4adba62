// What a lens does to the undistorted image of a pinhole: it bends normalised image coordinates n to m, and K takes m
// to pixels. What is straight in n is a curve in m; an area grows by det ∂m/∂n. So all that is made of straight lines
// (faces, edges, the view volume) is worked on in the undistorted image, K n, and samples alone are bent.
#pragma once

#include <cmath>
#include <concepts>
#include <limits>
#include <memory>
#include <optional>
#include <variant>
#include <vector>

#include "camera/brown_conrady.h"
#include "camera/equirectangular.h"
#include "camera/fisheye.h"
#include "camera/wide_fisheye.h"
#include "core/math.h"

namespace edgegrad {

// A pinhole.
struct PinholeLens {};

template <class L>
concept Lens = requires(const L lens, Vec2 n, Vec2& n_bar, double* coefficients_bar) {
    { L::coefficients } -> std::convertible_to<int>;
    { lens.distort(n) } -> std::same_as<Vec2>;
    { lens.jacobian(n) } -> std::same_as<Mat2>;  // ∂m/∂n
    lens.distort_vjp(n, n, n_bar, coefficients_bar);
};

// One that sees through the sides of a cube (cube_face.h), each of which is a sub-camera (sub_cameras.h).
template <class L>
concept SideLens = Lens<L> && requires(const L lens, Vec2 x, double reach, Box2 box) {
    { lens.scale() } -> std::same_as<Vec2>;
    { lens.side() } -> std::same_as<const CubeFace&>;
    { lens.turn() } -> std::same_as<Mat3>;
    { lens.has_pole() } -> std::same_as<bool>;
    { lens.undistort(x) } -> std::same_as<std::optional<Vec2>>;
    { lens.may_show(x, reach) } -> std::same_as<bool>;
    { lens.image_box(box) } -> std::same_as<Box2>;
    { lens.side_box(box) } -> std::same_as<std::optional<Box2>>;
    { lens.stretch(box) } -> std::same_as<double>;
};
static_assert(SideLens<Equirectangular> && SideLens<WideFisheye>);

// One that is radial, nearly: |m| at |n| = r but for what is not, its derivative, and the radii up to a greatest at
// which one of these changes its sign. And whether it is radial altogether.
template <class L>
concept RadialLens = Lens<L> && requires(const L lens, double r) {
    { lens.radius(r) } -> std::same_as<double>;
    { lens.radius_slope(r) } -> std::same_as<double>;
    { lens.turning_radii(r) } -> std::same_as<std::vector<double>>;
    { lens.is_radial() } -> std::same_as<bool>;
};
static_assert(RadialLens<BrownConrady> && RadialLens<Fisheye>);

// A new lens is a file of its own, and a place in this list.
using AnyLens = std::variant<PinholeLens, BrownConrady, Fisheye, Equirectangular, WideFisheye>;
constexpr int most_coefficients = 8;  // that a camera is given
static_assert(BrownConrady::coefficients <= most_coefficients && Fisheye::coefficients <= most_coefficients);
constexpr int most_parameters = 10;  // of a lens: where it sees through a side, K comes first
static_assert(most_coefficients <= most_parameters && Equirectangular::coefficients <= most_parameters &&
              WideFisheye::coefficients <= most_parameters);

// f(lens), of one that is nearly radial; of one that sees through a side, or something else; of any that is not
// straight.
template <class F>
auto with_radial_lens(const AnyLens& lens, F f) {
    if (const auto* l = std::get_if<BrownConrady>(&lens)) return f(*l);
    return f(*std::get_if<Fisheye>(&lens));
}
template <class Result, class F>
Result with_side_lens(const AnyLens& lens, Result otherwise, F f) {
    if (const auto* l = std::get_if<Equirectangular>(&lens)) return f(*l);
    if (const auto* l = std::get_if<WideFisheye>(&lens)) return f(*l);
    return otherwise;
}
template <class F>
auto with_lens(const AnyLens& lens, F f) {
    if (const auto* l = std::get_if<Equirectangular>(&lens)) return f(*l);
    if (const auto* l = std::get_if<WideFisheye>(&lens)) return f(*l);
    return with_radial_lens(lens, f);
}
inline bool has_sides(const AnyLens& lens) {
    return with_side_lens(lens, false, [](const auto&) { return true; });
}

class RadialInverse;

// The disc in which every m of a radial lens has one n: what lies beyond is not seen.
struct LensDisc {
    double fold = std::numeric_limits<double>::infinity();  // the least |n| with det ∂m/∂n ≤ 0; or greatest_radius
    double reach = fold;                                    // no |m| from within is greater
    // The table of the lens's radial part (radial_inverse.h); null where there is none.
    std::shared_ptr<const RadialInverse> inverse = {};
};
LensDisc disc_of(const AnyLens& lens);
// The n with |n| = fold at which det ∂m/∂n is least, of those by which the fold was found.
Vec2 folding_place(const BrownConrady& lens, const LensDisc& disc);
constexpr double greatest_radius = 30;  // 88° from the axis; what shows more sees through sides

// The r in [0, fold] that the radial part of a lens takes to m, or the fold.
double undistorted_radius(const AnyLens& lens, double fold, double m);

// The n in the disc that is bent to m; none if there is none.
std::optional<Vec2> undistort(const AnyLens& lens, const LensDisc& disc, Vec2 m);

// The same for k points near m0, in place; not numbers where there is none.
void undistort_near(const AnyLens& lens, const LensDisc& disc, Vec2 m0, int k, double* x, double* y);

}  // namespace edgegrad
