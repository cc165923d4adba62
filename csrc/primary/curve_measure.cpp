#include "primary/curve_measure.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <optional>

#include "estimator/default_samples.h"
#include "primary/crease_control.h"
#include "primary/crease_faces.h"
#include "primary/crease_visibility.h"
#include "primary/hidden_curves.h"
#include "primary/intersection_measure.h"
#include "primary/jump_scale.h"

namespace edgegrad {

namespace {

// Returns the default samples per pixel of curve at the usual samples of the image; see surface_measure.cpp. A lit
// sample costs three times as much, and most of the error is that of faces. A quarter of the samples adds a tenth at
// most (docs/tried.md).
double samples_per_pixel(bool lit) { return lit ? 6 : 24; }

// An error counts relative to the whole gradient. Controls have none, so the more they cover, the fewer samples the
// rest needs. The rest's error falls as one over their number. Its part of the gradient, a vector by vertices, is about
// √(Σ measure² of the rest / Σ measure² of all). The bound least_rest applies, because a motion that all vertices share
// feels silhouettes more than creases. Drawing least_samples takes a few milliseconds.
constexpr double least_rest = 1.0 / 5, least_samples = 1 << 12;

// Returns how far, in pixels, a ray may miss the points of a curve. It is limited to a hundredth: beyond that the image
// shows rounding, not faces.
template <class T>
double reach_of_rays(const BackwardView<T>& view, const Curve& c) {
    double error = 0;
    const HalfEdge& h = c.minus.face >= 0 ? c.minus : c.plus;
    for (const int corner : {h.first(), h.second()}) {
        const double* p = view.scene.verts + 3 * int64_t(vertex(view.scene, h, corner));
        error = std::max(error, view.frame.error({p[0], p[1], p[2]}));
    }
    return std::max(c.rounding, std::min(view.camera.pixels_per_unit / std::min(c.w0, c.w1) * error, float_reach));
}

template <class T>
ImageSegment image_segment(const BackwardView<T>& view, const Curve& c, int64_t curve) {
    return {.edge = int32_t(c.edge),
            .curve = int32_t(curve),
            .a = c.x0,
            .b = c.x1,
            .reach = reach_of_rays(view, c),
            .rounding = c.rounding,
            .depth = c.nearest_depth()};
}

// CreaseHints holds what tells the visibility of creases without a sample.
template <class T>
struct CreaseHints {
    const SilhouetteGrid silhouette_grid;
    const OverlappingParts overlapping_parts;
    std::optional<CreaseFaces<T>>
        faces;  // none where faces are alpha-tested: it does not treat their alpha edges as silhouettes

    CreaseHints(const BackwardView<T>& view, const CurveFinder<T>& finder,
                const std::vector<std::vector<ImageSegment>>& silhouettes)
        : silhouette_grid(silhouettes, view.camera.width, view.camera.height, view.team),
          overlapping_parts(view.hit, view.scene.faces, view.geometry.parts(), view.camera.width, view.camera.height,
                            view.team) {
        if (!view.scene.alpha_masks.face) faces.emplace(view, finder, silhouette_grid, overlapping_parts);
    }
};

// MeasuredEdges measures the curves of one chunk of edges.
template <class T>
class MeasuredEdges {
    using Relation = SilhouetteGrid::Relation;

   public:
    // `hints`, and `x`, to which controls are added, are null if there are no controls.
    MeasuredEdges(const BackwardView<T>& view, const CurveFinder<T>& finder, const JumpScale& scale,
                  const CreaseHints<T>* hints, RowBuffer* x)
        : view_(view),
          finder_(finder),
          scale_(scale),
          faces_(hints && hints->faces ? &*hints->faces : nullptr),
          x_(x),
          control_(make_crease_control(view)) {
        if (hints) visibility_.emplace(view, hints->silhouette_grid, hints->overlapping_parts);
    }

    CurvesFound found;
    std::vector<MeasuredCurve> curves;
    std::vector<ImageSegment> segments;

    std::vector<ClearCrease> clear;
    bool any_hidden = false;

    void add(int64_t first, int64_t last) {
        if (faces_) curves.reserve(last - first);  // where faces differ nearly all edges are curves
        finder_.each(first, last, FaceEarlyOut{*this}, [&](int64_t e) {
            if (!add_clear(e)) add_any(e);
        });
        answer();
    }

   private:
    // A Jump holds the factors of a curve's measure besides its length: the sizes of the jump and of the adjoint.
    struct Jump {
        int64_t curve;  // index in `curves`
        double size, importance;
    };

    // FaceEarlyOut skips edges by what is known of the faces on both sides.
    struct FaceEarlyOut {
        MeasuredEdges& edges;
        using EarlyOut = typename CurveFinder<T>::EarlyOut;

        EarlyOut operator()(int64_t e, int32_t f, int32_t g) const {
            if (!edges.faces_) return EarlyOut::unknown;
            const CreaseFace &one = (*edges.faces_)[f], &other = (*edges.faces_)[g];
            if (one.value == other.value || std::isnan(one.value + other.value)) return EarlyOut::unknown;
            if (!one.is_hidden() || !other.is_hidden()) return EarlyOut::differs;
            edges.add_hidden(e, one, other);
            return EarlyOut::done;
        }
        void prefetch(int32_t face) const {
            if (edges.faces_) edgegrad::prefetch(&(*edges.faces_)[face]);
        }
    };

    // Adds a crease between hidden faces. It gets so few samples that the size of its jump does not matter.
    void add_hidden(int64_t e, const CreaseFace& one, const CreaseFace& other) {
        const bool alone = one.state == CreaseFace::hidden && other.state == CreaseFace::hidden;
        ++found.creases;
        if (!(one.importance > 0 && other.importance > 0)) return;
        const double pixels = alone ? std::min(one.pixels, other.pixels) : add_turned(e);
        if (!(pixels > 0)) return;
        found.pixels += pixels;
        any_hidden |= alone;
        const MeasuredCurve curve{
            .measure = pixels * std::max(one.importance, other.importance), .edge = int32_t(e), .hidden = alone};
        curves.push_back(curve);
    }

    // Adds the segment of the next curve, a crease on the back of a mesh, before which a silhouette may pass. Returns
    // its measure without the adjoint.
    double add_turned(int64_t e) {
        Curve c;
        if (!finder_.find_between(e, c)) return 0;
        c.rounding = finder_.rounding(c);
        segments.push_back(image_segment(view_, c, int64_t(curves.size())));
        const bool apart = visibility_->relation(c) == Relation::apart;
        return c.length * (apart ? CreaseSamples::turned_away : ImageHits::turned_away);
    }

    // Adds a crease between wholly visible faces, one of them hit, or between hidden faces. Else returns false.
    bool add_clear(int64_t e) {
        const Topology& topology = view_.geometry.topology();
        if (!faces_ || !topology.joins_two(e)) return false;
        const auto sides = topology.faces(e);
        if (finder_.facing()[sides[0]] * finder_.facing()[sides[1]] <= 0) return false;
        const CreaseFace &one = (*faces_)[sides[0]], &other = (*faces_)[sides[1]];
        if (one.is_hidden() && other.is_hidden()) return add_hidden(e, one, other), true;
        if (std::min(one.state, other.state) < CreaseFace::clear || std::max(one.state, other.state) < CreaseFace::seen)
            return false;
        Curve c;
        if (!finder_.find_between(e, c) || !control_->set(c)) return false;
        ++found.creases;
        const Jump jump{int64_t(curves.size()), relative(control_->jump(scale_.weights)),
                        view_.importance.mean(c.low(), c.high())};
        if (!(jump.importance > 0)) return true;
        clear.push_back({int32_t(curves.size()), CellMarks::around(c.low(), c.high())});
        curves.push_back({.edge = int32_t(e)});
        expect(c, jump, {true, OcclusionHint::factor(CreaseSamples::visible, view_.image.spp)});
        return true;
    }

    void add_any(int64_t e) {
        Curve c;
        if (!finder_.find(e, c)) return;
        ++(c.is_crease() ? found.creases : found.silhouettes);
        const auto [low, high] = view_.camera.image_box(c.low(), c.high());
        const Jump jump{int64_t(curves.size()), size_of_jump(c), view_.importance.mean(low, high)};
        if (!(jump.importance > 0) || !std::isfinite(c.length)) return;
        curves.push_back({.edge = int32_t(e)});
        const int64_t hiding = hiding_pixels(view_.occlusion, low, high, c.nearest_depth());
        if (c.is_crease() && visibility_) {
            add_crease(c, jump, hiding);
        } else {
            segments.push_back(image_segment(view_, c, jump.curve));
            measure(c, jump,
                    std::min(hiding ? view_.occlusion.factor(occluded_curve, double(hiding), view_.image.spp) : 1,
                             next_to_unhit(view_, c.minus.face >= 0 ? c.minus.face : c.plus.face)));
        }
    }

    void measure(const Curve& c, const Jump& jump, double samples) {
        MeasuredCurve& curve = curves[jump.curve];
        const double pixels = c.length * view_.camera.stretch(c.low(), c.high()) * jump.size;
        curve.measure = pixels * samples * jump.importance;
        found.pixels += pixels * samples;
        const double square = std::pow(pixels * jump.importance, 2);
        found.unknown += square * samples, found.squares += square * (curve.controlled ? 1 : samples);
    }

    void add_crease(const Curve& c, const Jump& jump, int64_t hiding) {
        const Relation relation = visibility_->relation(c);
        segments.push_back(image_segment(view_, c, jump.curve));
        if (hiding) return measure(c, jump, visibility_->hidden(relation, hiding).samples);
        const bool controls = control_->set(c);
        if (const auto expected = visibility_->without_rays(c, controls ? relation : Relation::across)) {
            if (controls) expect(c, jump, *expected);
            else measure(c, jump, expected->samples);
            return;
        }
        tested_[visibility_->ask(c, relation)] = jump;
        if (visibility_->full()) answer();
    }

    void answer() {
        if (!visibility_) return;
        visibility_->answer([&](int k, const Curve& c, PredictedVisibility expected) {
            control_->set(c);
            expect(c, tested_[k], expected);
        });
    }

    void expect(const Curve& c, const Jump& jump, PredictedVisibility expected) {
        if (expected.visible) {
            curves[jump.curve].controlled = true;
            control_->add_integral();
            control_->flush(*x_);
        }
        measure(c, jump, control_->density(expected.samples));
    }

    // Returns the jump relative to the mean, which stands in where nothing is known.
    double size_of_jump(const Curve& c) {
        if (!joins_colors(view_.scene, c)) return 1;
        return relative(control_->jump_between(c.minus, c.plus, scale_.weights));
    }
    double relative(double jump) const {
        const double size = jump / scale_.unknown;
        return size > 0 && !visibility_ ? std::clamp(size, least_jump, largest_jump) : std::min(size, largest_jump);
    }

    static constexpr double largest_jump = 2;  // keeps a bright face among dark ones from taking all samples
    // This bound holds where samples alone find the jump. They look slightly aside of the curve (accumulation.cpp),
    // where a texture may differ across a nearly coplanar crease. Such a sample must not have a large weight.
    static constexpr double least_jump = 1.0 / 1024;
    const BackwardView<T>& view_;
    const CurveFinder<T>& finder_;
    const JumpScale& scale_;
    const CreaseFaces<T>* faces_;
    RowBuffer* x_;
    const std::unique_ptr<CreaseControl> control_;
    std::optional<CreaseVisibility<T>> visibility_;
    Jump tested_[CreaseVisibility<T>::most];
};

// Measures the lens boundary, where the adjoint is not zero. The jump is unknown.
template <class T>
void measure_lens_boundary(const BackwardView<T>& view, Curves<T>& out) {
    if (!view.camera.lens_view.end) return;
    for (const LensBoundaryArc& arc : out.lens_boundary_curve.emplace(view.camera, view.importance).arcs) {
        out.lens_boundary += arc.length, out.pixels += arc.length;
        out.squares += arc.measure * arc.measure, out.unknown += arc.measure * arc.measure;
    }
}

// Returns the segments of silhouettes and borders.
template <class T>
std::vector<std::vector<ImageSegment>> silhouettes(const BackwardView<T>& view, const CurveFinder<T>& finder) {
    return view.team.map_blocks(view.geometry.topology().n_edges(), [&](int64_t first, int64_t last) {
        std::vector<ImageSegment> part;
        finder.each(first, last, typename CurveFinder<T>::NoCreases(), [&](int64_t e) {
            Curve c;
            if (finder.find(e, c) && !c.is_crease() && std::isfinite(c.length))
                part.push_back(image_segment(view, c, 0));
        });
        return part;
    });
}

}  // namespace

template <class T>
Curves<T>::Curves(const BackwardView<T>& view, Array<int8_t> facing)
    : finder(view, std::move(facing)),
      x_bar(zeros(view.hits && finder.finds_creases() && view.options.controls && view.camera.is_undistorted()
                      ? 2 * view.scene.n_verts
                      : 0,
                  view.team)) {}

template <class T>
int64_t Curves<T>::wanted(const GradientOptions& o, int spp) const {
    if (!(pixels > 0)) return 0;
    if (o.edge_samples >= 0) return o.edge_samples;
    const double rest = squares > 0 ? std::clamp(std::sqrt(unknown / squares), least_rest, 1.0) : 1;
    const double all = samples_per_pixel(o.lit) * pixels;
    return int64_t(std::ceil(sample_growth(spp) * std::max(rest * all, std::min(all, least_samples))));
}

template <class T>
void Curves<T>::add_segments(const BackwardView<T>& view, const Systematic& samples, bool all) {
    const int64_t n = int64_t(segments.size());
    const auto segment = [&](int64_t k) {
        Curve c;
        finder.find_between(curve[k].edge, c);
        c.rounding = finder.rounding(c);
        return image_segment(view, c, k);
    };
    if (all) {
        auto hidden = view.team.map_blocks(int64_t(curve.size()), [&](int64_t first, int64_t last) {
            std::vector<ImageSegment> part;
            for (int64_t k = first; k < last; ++k)
                if (curve[k].hidden) part.push_back(segment(k));
            return part;
        });
        segments.insert(segments.end(), std::make_move_iterator(hidden.begin()), std::make_move_iterator(hidden.end()));
    }
    if (std::all_of(clear.begin(), clear.end(), [](const auto& part) { return part.empty(); })) return;
    // Two curves on one line matter if either is sampled. Two clear creases never do.
    CellMarks marks(view.camera.width, view.camera.height), marks_of_sampled(view.camera.width, view.camera.height);
    if (!all)
        view.team.parallel_for(n, [&](int64_t part) {
            for (const ImageSegment& s : segments[part]) {
                marks.mark(s.a, s.b, s.reach);
                if (samples.may_draw(s.curve)) marks_of_sampled.mark(s.a, s.b, s.reach);
            }
        });
    view.team.parallel_for(int64_t(clear.size()), [&](int64_t part) {
        std::vector<ImageSegment> near;
        for (const ClearCrease& c : clear[part])
            if (all || marks_of_sampled.any(c.cells) || (samples.may_draw(c.curve) && marks.any(c.cells)))
                near.push_back(segment(c.curve));
        segments[part].insert(segments[part].end(), near.begin(), near.end());
    });
}

template <class T>
Curves<T> measure_curves(const BackwardView<T>& view, Array<int8_t> facing, bool lens_boundary) {
    Curves<T> out(view, std::move(facing));
    const int64_t E = view.geometry.topology().n_edges();
    const JumpScale scale = out.finder.finds_creases() ? jump_scale(view) : JumpScale{};
    std::optional<CreaseHints<T>> hints;
    if (!out.x_bar.empty()) hints.emplace(view, out.finder, silhouettes(view, out.finder));
    std::vector<CurvesFound> found;
    std::vector<std::vector<MeasuredCurve>> curves;
    std::vector<uint8_t> any_hidden;
    const auto measure = [&](int64_t k, int64_t first, int64_t last, RowBuffer* x) {
        MeasuredEdges<T> part(view, out.finder, scale, hints ? &*hints : nullptr, x);
        part.add(first, last);
        found[k] = part.found, curves[k] = std::move(part.curves), out.segments[k] = std::move(part.segments);
        out.clear[k] = std::move(part.clear);
        any_hidden[k] = part.any_hidden;
    };
    const auto resize = [&](int64_t n) {
        found.resize(n), curves.resize(n), out.segments.resize(n), out.clear.resize(n), any_hidden.resize(n);
    };
    if (out.x_bar.empty()) {
        resize(ThreadTeam::blocks(E));
        view.team.parallel_for_blocks(
            E, [&](int64_t k, int64_t first, int64_t last) { measure(k, first, last, nullptr); });
    } else {
        resize((E + scatter_chunk - 1) / scatter_chunk);
        GradientSink whole;
        whole.x = out.x_bar.data();
        double seconds[2] = {};
        view.scatter.add(E, whole, seconds, [&](int64_t first, int64_t last, LocalGradients& grad) {
            measure(first / scatter_chunk, first, last, &grad.x);
        });
    }
    for (const CurvesFound& f : found)
        out.pixels += f.pixels, out.silhouettes += f.silhouettes, out.creases += f.creases, out.squares += f.squares,
            out.unknown += f.unknown;
    std::vector<int64_t> first{0};  // index of the first curve of each part
    for (const auto& part : curves) first.push_back(first.back() + int64_t(part.size()));
    const int64_t n = first.back();
    measure_intersections(view, out);
    if (lens_boundary) measure_lens_boundary(view, out);
    out.curve = Array<MeasuredCurve>(n), out.measure = Array<double>(n + int64_t(out.intersection.size()) + out.arcs());
    int64_t next = n;
    for (const MeasuredIntersection& i : out.intersection) out.measure[next++] = i.measure;
    if (out.lens_boundary_curve)
        for (const LensBoundaryArc& arc : out.lens_boundary_curve->arcs) out.measure[next++] = arc.measure;
    view.team.parallel_for(int64_t(curves.size()), [&](int64_t k) {
        for (ImageSegment& s : out.segments[k]) s.curve += int32_t(first[k]);
        for (ClearCrease& c : out.clear[k]) c.curve += int32_t(first[k]);
        std::copy(curves[k].begin(), curves[k].end(), out.curve.begin() + first[k]);
        for (size_t i = 0; i < curves[k].size(); ++i) out.measure[first[k] + int64_t(i)] = curves[k][i].measure;
    });
    out.any_hidden = std::find(any_hidden.begin(), any_hidden.end(), 1) != any_hidden.end();
    return out;
}

template Curves<float> measure_curves(const BackwardView<float>&, Array<int8_t>, bool);
template Curves<double> measure_curves(const BackwardView<double>&, Array<int8_t>, bool);
template struct Curves<float>;
template struct Curves<double>;

}  // namespace edgegrad
