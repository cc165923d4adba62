// This file draws lines across each face that may have discontinuities, and takes samples where they meet one.

#include "discontinuities/discontinuities.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <vector>

#include "boundary/accumulation.h"
#include "boundary/curve_samples.h"
#include "boundary/discontinuity_finder.h"
#include "camera/polygon.h"
#include "core/sampler.h"
#include "core/stopwatch.h"
#include "discontinuities/discontinuity_source.h"
#include "estimator/default_samples.h"

namespace edgegrad {

namespace {

// A face behind the hits gets this fraction of its lines; see curve_measure.cpp.
constexpr OcclusionHint::HiddenFactor occluded_face_lines{.rays = 8, .share = 1.0 / 256, .least = 1.0 / 16};

// A Family is the lines at (k + shift) · spacing, k = first … end − 1.
struct Family {
    int64_t first = 0, end = 0;

    Family() = default;
    Family(double low, double high, double spacing, double shift)
        : first(int64_t(std::ceil(low / spacing - shift))), end(int64_t(std::ceil(high / spacing - shift))) {}
    int64_t count() const { return end - first; }
};

// A LinedFace is a face with the lines that cross it, where the adjoint is not zero.
struct LinedFace {
    int32_t face;
    double spacing;  // px of the undistorted image
    Vec2 low, high;  // box of the part in view
    Family horizontal, vertical;
    int64_t before = 0;  // number of lines of the faces before it

    int64_t count() const { return horizontal.count() + vertical.count(); }
};

static_assert(sizeof(LinedFace) * 3 <= lined_face_bytes);

// A line may visit this minimum of texture cells, and this number per spacing of its length, as lines lie at the usual
// samples of the image. Where texels are much smaller than pixels some stand for all, so the image bounds the time.
constexpr int fewest_cells = 32, cells_a_spacing = 2;

template <class T>
class DiscontinuityLines {
   public:
    explicit DiscontinuityLines(const BackwardView<T>& view)
        : view_(view),
          shift_{to_unit(seed_of(view.options.seed, Stream::discontinuity_rows)),
                 to_unit(seed_of(view.options.seed, Stream::discontinuity_columns))} {
        const SceneView<T>& scene = view.scene;
        const auto parts = view.team.map_blocks(scene.n_faces, [&](int64_t first, int64_t last) {
            std::vector<LinedFace> part;
            VisiblePolygon polygon;
            for (int64_t f = first; f < last; ++f)
                if (DiscontinuityFinder<T>::may_have_discontinuities(scene, f) &&
                    polygon.set(view.camera, view.volume, view.vertices, scene.faces + 3 * f))
                    add(int32_t(f), polygon, part);
            return part;
        });
        for (const auto& part : parts)
            for (LinedFace face : part) {
                face.before = count_, count_ += face.count();
                faces_.push_back(face);
            }
    }

    int64_t count() const { return count_; }

    // Calls body(face, a, b, vertical, line) for the lines first … last − 1, from a to b.
    template <class Body>
    void each(int64_t first, int64_t last, Body body) const {
        auto face = std::upper_bound(faces_.begin(), faces_.end(), first,
                                     [](int64_t line, const LinedFace& f) { return line < f.before; }) -
                    1;
        for (int64_t line = first; line < last; ++line) {
            while (line >= face->before + face->count()) ++face;
            const int64_t k = line - face->before, n = face->horizontal.count();
            const bool vertical = k >= n;
            const double place = vertical ? (double(face->vertical.first + k - n) + shift_[1]) * face->spacing
                                          : (double(face->horizontal.first + k) + shift_[0]) * face->spacing;
            const Vec2 a = vertical ? Vec2{place, face->low.y} : Vec2{face->low.x, place},
                       b = vertical ? Vec2{place, face->high.y} : Vec2{face->high.x, place};
            body(*face, a, b, vertical, line);
        }
    }

   private:
    void add(int32_t face, const VisiblePolygon& polygon, std::vector<LinedFace>& to) const {
        const auto [low, high] = view_.camera.image_box(polygon.low, polygon.high);
        if (!(view_.importance.mean(low, high) > 0)) return;
        double spacing = view_.options.discontinuity_spacing /
                         (sample_growth(view_.image.spp) * view_.camera.stretch(polygon.low, polygon.high));
        if (const int64_t hiding = view_.occlusion.hiding_pixels(low, high, polygon.nearest))
            spacing /= view_.occlusion.factor(occluded_face_lines, hiding, view_.image.spp);
        LinedFace lined{.face = face,
                        .spacing = spacing,
                        .low = polygon.low,
                        .high = polygon.high,
                        .horizontal = {polygon.low.y, polygon.high.y, spacing, shift_[0]},
                        .vertical = {polygon.low.x, polygon.high.x, spacing, shift_[1]}};
        if (lined.count() > 0) to.push_back(lined);
    }

    const BackwardView<T>& view_;
    const double shift_[2];  // shifts of the horizontal and of the vertical lines, in spacings
    std::vector<LinedFace> faces_;
    int64_t count_ = 0;
};

}  // namespace

template <class T>
void add_discontinuities(const BackwardView<T>& view, const Accumulation& accumulation, GradientSink& to,
                         BackwardProfile& profile) {
    Stopwatch watch;
    const DiscontinuityLines<T> lines(view);
    profile.discontinuity_lines = lines.count();
    profile.discontinuity[0] += watch.lap();
    if (view.options.dry || lines.count() == 0) return;
    const uint64_t seed = seed_of(view.options.seed, Stream::discontinuities);
    const double growth = sample_growth(view.image.spp);
    view.scatter.add(lines.count(), to, profile.discontinuity, [&](int64_t first, int64_t last, LocalGradients& grad) {
        DiscontinuitySource<T> source(view);
        const std::unique_ptr<CurveAccumulation> to_chunk = accumulate_curves(view, accumulation, grad);
        CurveSamples samples(view, source, *to_chunk);
        DiscontinuityFinder<T> finder(view);
        lines.each(first, last, [&](const LinedFace& face, Vec2 a, Vec2 b, bool vertical, int64_t line) {
            finder.set(face.face);
            const double spacings = std::min(length(b - a) / (growth * face.spacing), 1e6);
            const int most = fewest_cells + int(cells_a_spacing * spacings);
            finder.find(a, b, vertical, most, hash(seed, uint64_t(line)),
                        [&](const DiscontinuityCrossing& crossing, double weight) {
                            samples.add(crossing, 0, weight * face.spacing);
                        });
        });
        samples.finish(grad);
    });
}

template void add_discontinuities(const BackwardView<float>&, const Accumulation&, GradientSink&, BackwardProfile&);
template void add_discontinuities(const BackwardView<double>&, const Accumulation&, GradientSink&, BackwardProfile&);

}  // namespace edgegrad
