#include "curve_measure.h"

#include <algorithm>
#include <cmath>
#include <optional>

#include "crease_control.h"
#include "crease_visibility.h"

namespace edgegrad {

namespace {

// Default samples a pixel of curve; see surface_measure.cpp.
constexpr double samples_per_pixel = 24;

// What the measure of a silhouette is multiplied by if it lies behind what the image hit (occlusion.h). Never zero, for
// it may be visible all the same. What was merely not hit counts in full: at the limb of a fine mesh the faces beside a
// silhouette are a hundredth of a pixel wide and hit by chance. Of creases more is known: crease_visibility.h.
constexpr double occluded = 1.0 / 16;

// How far, in pixels, a ray may miss the points of a curve. A hundredth where it would be more: by then the image shows
// floats, not faces.
template <class T>
double reach_of_rays(const BackwardView<T>& view, const Curve& c) {
    double error = 0;
    const HalfEdge& h = c.minus.face >= 0 ? c.minus : c.plus;
    for (const int corner : {h.first(), h.second()}) {
        const double* p = view.scene.verts + 3 * int64_t(vertex(view.scene, h, corner));
        error = std::max(error, view.frame.error({p[0], p[1], p[2]}));
    }
    return std::max(c.rounding, std::min(view.camera.pixels_per_unit / std::min(c.w0, c.w1) * error, 0.01));
}

// Mean of Σ_c |L| over all colours: the size of a jump of which nothing is known.
template <class T>
double mean_radiance(const SceneView<T>& scene, Team& team) {
    std::vector<double> sum(Team::blocks(scene.n_colors), 0.0);
    team.each_block(scene.n_colors, [&](int64_t k, int64_t first, int64_t last) {
        for (int64_t i = first * scene.channels; i < last * scene.channels; ++i) sum[k] += std::fabs(scene.colors[i]);
    });
    double all = 0;
    for (const double s : sum) all += s;
    return scene.n_colors ? all / double(scene.n_colors) : 0;
}

double nearest_depth(const Curve& c) {
    return std::min((1 - c.t0) * c.a.z + c.t0 * c.b.z, (1 - c.t1) * c.a.z + c.t1 * c.b.z);
}

template <class T>
ImageSegment image_segment(const BackwardView<T>& view, const Curve& c) {
    return {.edge = c.edge,
            .a = c.x0,
            .b = c.x1,
            .reach = reach_of_rays(view, c),
            .rounding = c.rounding,
            .depth = nearest_depth(c)};
}

// What tells of creases without a sample.
struct CreaseHints {
    Crossings crossings;
    MeetingParts meeting;
};

// The curves of one chunk of edges.
template <int N, class T>
class MeasuredEdges {
    using Relation = Crossings::Relation;

   public:
    // `hints`, and `x`, where controls go: null if there are no controls.
    MeasuredEdges(const BackwardView<T>& view, double radiance, const CreaseHints* hints, Curves<T>& out, RowBuffer* x)
        : view_(view), radiance_(radiance), out_(out), x_(x), control_(view) {
        if (hints) visibility_.emplace(view, hints->crossings, hints->meeting);
    }

    CurvesFound found;
    std::vector<ImageSegment> segments;

    void add(int64_t first, int64_t last) {
        for (int64_t e = first; e < last; ++e) {
            Curve c;
            out_.of_edge[e] = 0;
            if (x_) out_.is_controlled[e] = 0;
            if (!out_.finder.find(e, c)) continue;
            ++(c.is_crease() ? found.creases : found.silhouettes);
            const Vec2 low{std::min(c.x0.x, c.x1.x), std::min(c.x0.y, c.x1.y)};
            const Vec2 high{std::max(c.x0.x, c.x1.x), std::max(c.x0.y, c.x1.y)};
            const double importance = view_.importance.mean(low, high);
            if (!(importance > 0) || !std::isfinite(c.length)) continue;
            const bool hidden = view_.occlusion.hides(low, high, nearest_depth(c));
            const Measured m{.jump = jump(c), .importance = importance};
            if (c.is_crease() && visibility_) {
                add_crease(c, hidden, m);
            } else {
                segments.push_back(image_segment(view_, c));
                measure(c, m, hidden ? fewer(occluded) : 1);
            }
        }
        answer();
    }

   private:
    // What the density of samples is multiplied by: size of the jump, of the adjoint.
    struct Measured {
        double jump, importance;
    };

    void measure(const Curve& c, const Measured& m, double samples) {
        const double pixels = c.length * m.jump * samples;
        out_.of_edge[c.edge] = pixels * m.importance;
        found.pixels += pixels;
    }
    double fewer(double factor) const { return OcclusionHint::factor(factor, view_.options.spp); }

    void add_crease(const Curve& c, bool hidden, const Measured& m) {
        const Relation relation = visibility_->relation(c);
        // On the line of a crease that no silhouette meets, nothing else is visible.
        if (relation != Relation::apart) segments.push_back(image_segment(view_, c));
        if (hidden) return measure(c, m, fewer(visibility_->hidden(relation).samples));
        const bool controls = control_.set(c);
        if (const auto expected = visibility_->without_rays(c, controls ? relation : Relation::across)) {
            if (controls) expect(c, *expected, m);
            else measure(c, m, expected->samples);
            return;
        }
        asked_[visibility_->ask(c, relation)] = m;
        if (visibility_->full()) answer();
    }

    void answer() {
        if (!visibility_) return;
        visibility_->answer([&](int k, const Curve& c, Expected expected) {
            control_.set(c);
            expect(c, expected, asked_[k]);
        });
    }

    void expect(const Curve& c, Expected expected, const Measured& m) {
        if (expected.visible) {
            out_.is_controlled[c.edge] = 1;
            control_.add_integral();
            control_.flush(*x_);
        }
        measure(c, m, control_.density(expected.samples));
    }

    // The size of the jump relative to one of the size of the mean radiance, which is taken where nothing is known.
    double jump(const Curve& c) {
        if (!joins_colors(view_.scene, c)) return 1;
        const CreaseColors<T> colors(view_.scene, c);
        const int C = view_.scene.channels;
        return std::min(0.5 * (colors.size(0, C) + colors.size(1, C)) / radiance_, largest);
    }

    static constexpr double largest = 2;  // so that a bright face among dark ones does not take all samples
    const BackwardView<T>& view_;
    const double radiance_;
    Curves<T>& out_;
    RowBuffer* x_;
    CreaseControl<N, T> control_;
    std::optional<CreaseVisibility<T>> visibility_;
    Measured asked_[CreaseVisibility<T>::most];
};

// Silhouettes and borders.
template <class T>
std::vector<std::vector<ImageSegment>> silhouettes(const BackwardView<T>& view, const CurveFinder<T>& finder) {
    const int64_t E = view.geometry.topology().n_edges();
    std::vector<std::vector<ImageSegment>> parts(Team::blocks(E));
    view.team.each_block(E, [&](int64_t k, int64_t first, int64_t last) {
        for (int64_t e = first; e < last; ++e) {
            Curve c;
            if (finder.has_face_on_each_side(e) || !finder.find(e, c) || c.is_crease()) continue;
            if (std::isfinite(c.length)) parts[k].push_back(image_segment(view, c));
        }
    });
    return parts;
}

}  // namespace

template <class T>
Curves<T>::Curves(const BackwardView<T>& view)
    : finder(view),
      of_edge(view.geometry.topology().n_edges()),
      x_bar(zeros(view.hits && finder.finds_creases() && !view.options.dry ? 2 * view.scene.n_verts : 0, view.team)),
      is_controlled(x_bar.empty() ? 0 : of_edge.size()) {}

template <class T>
int64_t Curves<T>::wanted(int64_t given) const {
    if (!(pixels > 0)) return 0;
    return given >= 0 ? given : int64_t(std::ceil(samples_per_pixel * pixels));
}

template <int N, class T>
Curves<T> measure_curves(const BackwardView<T>& view) {
    Curves<T> out(view);
    const int64_t E = out.of_edge.size();
    const double radiance = mean_radiance(view.scene, view.team);
    std::vector<CurvesFound> parts;
    const int width = view.camera.width, height = view.camera.height;
    std::optional<CreaseHints> hints;
    if (!out.x_bar.empty())
        hints.emplace(Crossings(silhouettes(view, out.finder), width, height, view.team),
                      MeetingParts(view.hit, view.scene.faces, view.geometry.parts(), width, height, view.team));
    const auto measure = [&](int64_t k, int64_t first, int64_t last, RowBuffer* x) {
        MeasuredEdges<N, T> part(view, radiance, hints ? &*hints : nullptr, out, x);
        part.add(first, last);
        parts[k] = part.found, out.segments[k] = std::move(part.segments);
    };
    const auto resize = [&](int64_t n) { parts.resize(n), out.segments.resize(n); };
    if (out.x_bar.empty()) {
        resize(Team::blocks(E));
        view.team.each_block(E, [&](int64_t k, int64_t first, int64_t last) { measure(k, first, last, nullptr); });
    } else {
        resize((E + scatter_chunk - 1) / scatter_chunk);
        Destination whole;
        whole.x = out.x_bar.data();
        double seconds[2] = {};
        view.scatter.add(E, whole, seconds, [&](int64_t first, int64_t last, ChunkGrad& grad) {
            measure(first / scatter_chunk, first, last, &grad.x);
        });
    }
    for (const CurvesFound& part : parts)
        out.pixels += part.pixels, out.silhouettes += part.silhouettes, out.creases += part.creases;
    return out;
}

// clang-format off
#define EDGEGRAD_INSTANTIATE(N) \
    template Curves<float> measure_curves<N>(const BackwardView<float>&); \
    template Curves<double> measure_curves<N>(const BackwardView<double>&);
EDGEGRAD_FOR_CHANNELS(EDGEGRAD_INSTANTIATE)
#undef EDGEGRAD_INSTANTIATE
template struct Curves<float>;
template struct Curves<double>;
// clang-format on

}  // namespace edgegrad
