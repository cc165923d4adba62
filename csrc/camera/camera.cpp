#include "camera/camera.h"

#include <algorithm>
#include <array>
#include <bit>
#include <memory>
#include <mutex>
#include <vector>

#include "camera/radial_inverse.h"

namespace edgegrad {

namespace {

constexpr double margin = 1;  // A filter may reach this many px over the border of the image.

// This cache keeps the visible parts of recent lenses. They depend on a camera's size, K and coefficients alone, and
// finding one takes as long as a small image. Each entry takes about 10 KiB.
class LensViews {
   public:
    using Key = std::array<uint64_t, 9 + most_coefficients>;
    struct View {
        Key key;
        AnyLens lens;  // A fisheye may have become a WideFisheye.
        LensView view;
    };

    static Key key_of(const Camera& c) {
        Key key{c.lens.index(), uint64_t(c.width), uint64_t(c.height)};
        for (int i = 0; i < 6; ++i) key[3 + i] = std::bit_cast<uint64_t>(c.k[i]);
        with_radial_lens(c.lens, [&]<class L>(const L& lens) {
            const auto words = std::bit_cast<std::array<uint64_t, L::coefficients>>(lens);
            std::copy(words.begin(), words.end(), key.begin() + 9);
        });
        return key;
    }

    bool find(const Key& key, Camera& c) {
        const std::lock_guard lock(mutex_);
        for (const View& kept : kept_)
            if (kept.key == key) return c.lens = kept.lens, c.lens_view = kept.view, true;
        return false;
    }
    void keep(const Key& key, const Camera& c) {
        const std::lock_guard lock(mutex_);
        if (kept_.size() < most) kept_.push_back({key, c.lens, c.lens_view});
        else kept_[oldest_++ % most] = {key, c.lens, c.lens_view};
    }

   private:
    static constexpr size_t most = 64;
    std::mutex mutex_;
    std::vector<View> kept_;
    size_t oldest_ = 0;
};

LensViews& lens_views() {
    static auto* views = new LensViews;  // never freed, as threads may outlive the end of main()
    return *views;
}

}  // namespace

void Camera::look_through_lens() {
    const LensViews::Key key = LensViews::key_of(*this);
    if (lens_views().find(key, *this)) return;
    find_lens_view();
    lens_views().keep(key, *this);
}

void Camera::find_lens_view() {
    lens_view = view_through_lens();
    const auto* fisheye = std::get_if<Fisheye>(&lens);
    if (!fisheye || !lens_view.end || lens_view.disc.fold < greatest_radius) return;
    const WideFisheye wide(k, *fisheye);
    lens_view = {};
    if (wide.ends_in({{-margin, -margin}, {width + margin, height + margin}})) lens_view.end = wide.lens_boundary();
    lens = wide;
}

LensView Camera::view_through_lens() const {
    LensView view;
    view.disc = disc_of(lens);
    double most = 0;
    for (const Vec2 x : {Vec2{-margin, -margin},
                         {width + margin, -margin},
                         {-margin, height + margin},
                         {width + margin, height + margin}})
        most = std::max(most, length(normalised(*this, x)));
    view.disc.inverse = std::make_shared<const RadialInverse>(lens, view.disc.fold, (1 + 1e-9) * most);
    // The border of the image suffices, because whatever is seen within it lies within its image.
    constexpr int points = 256;  // Each side has these.
    constexpr double infinite = std::numeric_limits<double>::infinity();
    Vec2 low{infinite, infinite}, high{-infinite, -infinite};
    const auto add = [&](Vec2 u) {
        low = {std::min(low.x, u.x), std::min(low.y, u.y)}, high = {std::max(high.x, u.x), std::max(high.y, u.y)};
    };
    for (int i = 0; i < points && !view.end; ++i) {
        const double s = double(i) / points, w = width + 2 * margin, h = height + 2 * margin;
        for (const Vec2 x : {Vec2{s * w, 0}, Vec2{w, s * h}, Vec2{(1 - s) * w, h}, Vec2{0, (1 - s) * h}}) {
            const auto n = edgegrad::undistort(lens, view.disc, normalised(*this, x - Vec2{margin, margin}));
            if (!n) view.end = std::atan(view.disc.fold);
            else add(to_pixels(*this, *n));
        }
    }
    double radius = view.disc.fold;
    if (view.end) {
        // K maps the whole disc to an ellipse.
        const Vec2 reach{std::hypot(k[0], k[1]) * radius, std::hypot(k[3], k[4]) * radius};
        low = Vec2{k[2], k[5]} - reach, high = Vec2{k[2], k[5]} + reach;
    } else {
        // Between its points, the border is distorted by less than about a hundredth of their distance.
        const Vec2 more = (1.0 / points) * (high - low);
        low = low - more, high += more;
        double farthest = 0;
        for (const Vec2 u : {low, {high.x, low.y}, high, {low.x, high.y}})
            farthest = std::max(farthest, length(normalised(*this, u)));
        radius = std::min(radius, farthest);
    }
    view.low = low, view.high = high;
    // The derivatives are smooth; they change by less than a twentieth between neighbouring samples.
    constexpr int radii = 64, angles = 16;
    for (int i = 0; i <= radii; ++i)
        for (int j = 0; j < angles; ++j) {
            const double r = std::tan(std::atan(radius) * i / radii) * (1 - 1e-12), a = 2 * M_PI * j / angles;
            const Vec2 n{r * std::cos(a), r * std::sin(a)};
            const Vec2 x = distort_jvp(*this, n, {1, 0}), y = distort_jvp(*this, n, {0, 1});
            const auto raise = [](double& most, double value) { most = std::max(most, 1.05 * std::fabs(value)); };
            raise(view.most.xx, x.x), raise(view.most.yx, x.y), raise(view.most.xy, y.x), raise(view.most.yy, y.y);
        }
    return view;
}

namespace {

// Returns the box for a camera without skew.
Box2 normalised_box(const Camera& c, Vec2 low, Vec2 high) {
    const Vec2 a = normalised(c, low), b = normalised(c, high);
    return {{std::min(a.x, b.x), std::min(a.y, b.y)}, {std::max(a.x, b.x), std::max(a.y, b.y)}};
}

}  // namespace

double Camera::stretch(Vec2 low, Vec2 high) const {
    return with_cube_face_lens(lens, 1.0, [&](const auto& l) { return l.stretch(normalised_box(*this, low, high)); });
}

// Uses the mean value theorem from a point of the box, or from the nearest visible one.
std::pair<Vec2, Vec2> Camera::image_box(Vec2 low, Vec2 high) const {
    if (is_undistorted()) return {low, high};
    if (has_cube_faces(lens)) {
        const Box2 n = normalised_box(*this, low, high);
        const Box2 box = with_cube_face_lens(lens, n, [&](const auto& l) { return l.image_box(n); });
        return {box.low, box.high};
    }
    Vec2 n = normalised(*this, 0.5 * (low + high));
    const double radius = length(n), fold = lens_view.disc.fold * (1 - 1e-9);
    if (radius > fold) n = (fold / radius) * n;
    const Vec2 u = to_pixels(*this, n), x = distort(*this, u).x;
    const Vec2 half{std::max(high.x - u.x, u.x - low.x), std::max(high.y - u.y, u.y - low.y)};
    const Vec2 reach{lens_view.most.xx * half.x + lens_view.most.xy * half.y,
                     lens_view.most.yx * half.x + lens_view.most.yy * half.y};
    return {x - reach, x + reach};
}

}  // namespace edgegrad
