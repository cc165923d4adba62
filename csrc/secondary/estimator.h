// This file holds the estimator of curves at which visibility between surfaces and their light changes: of shadow
// boundaries and secondary edges, whether the camera sees them or not.
//
// A sampler lays the curves end to end by a measure that needs no ray. Pilots then estimate what lines of light past
// the curves contribute, and set the pdf of the samples. Samples are systematic (core/systematic.h). A receiver takes
// the points where these lines end: those in view of the camera, or all on surfaces.
//
// A sampler offers:
//   is_empty()               returns whether there are no curves
//   cast_pilots(receiver)    calls receiver.cast_pilots(trace, found) for each block of pilots
//   lay_out(n)               returns at how many places about n samples lie, by the pdf that the pilots set
//   trace(first, last, body) calls body(point, weight) for the points that lines from these places meet
// A receiver offers:
//   cast_pilots(trace, found)  calls found(point, value) for the points of trace(body) that count
//   record(trace, grad)        records those points
#pragma once

#include <algorithm>
#include <cstdint>
#include <utility>

#include "boundary/accumulation.h"
#include "boundary/curve_samples.h"
#include "core/systematic.h"
#include "estimator/default_samples.h"
#include "estimator/view.h"

namespace edgegrad {

// This is the default per pixel of a point light's shadow boundary, at the usual samples of the image.
constexpr double shadow_samples_a_pixel = 24;

// Returns the minimum of the default number of samples.
inline int64_t fewest_secondary_samples(int spp) { return int64_t(256 * sample_growth(spp)); }

// Returns the default number of samples for an image of this size and samples per pixel; for shadow boundaries, the
// maximum. A sample casts an incoherent ray from the light and one from the camera, so rays are limited to an eighth of
// the image's.
inline int64_t default_secondary_samples(int64_t width, int64_t height, int spp) {
    const auto most = int64_t((1 << 18) * sample_growth(spp));
    return std::clamp(width * height * spp / 8, fewest_secondary_samples(spp), most);
}
template <class T>
int64_t default_secondary_samples(const BackwardView<T>& view) {
    return default_secondary_samples(view.camera.width, view.camera.height, view.image.spp);
}

// Records samples at the points that the receiver takes. number() returns how many, once pilots are cast.
template <class T, class Sampler, class Receiver, class Number>
void record_secondary(const BackwardView<T>& view, Sampler& sampler, const Receiver& receiver, Number number,
                      GradientSink& to) {
    if (sampler.is_empty()) return;
    sampler.cast_pilots(receiver);
    const int64_t n = number(), places = n > 0 ? sampler.lay_out(n) : 0;
    double seconds[2] = {};
    view.scatter.add(places, to, seconds, [&](int64_t first, int64_t last, LocalGradients& grad) {
        receiver.record([&](auto body) { sampler.trace(first, last, body); }, grad);
    });
}

// CurvesInView receives the points that the camera sees. value(source, sample) is what a pilot finds there.
template <class T, CurveSource Source, class Value>
class CurvesInView {
   public:
    CurvesInView(const BackwardView<T>& view, const Source& source, const Record& record, Value value)
        : view_(view), source_(source), record_(record), value_(value) {}

    template <class Trace, class Found>
    void cast_pilots(Trace trace, Found found) const {
        VisiblePilots<Found> pilots{value_, found};
        LocalGradients unused;
        add(trace, pilots, unused);
    }
    template <class Trace>
    void record(Trace trace, LocalGradients& grad) const {
        add(trace, *accumulate_curves(view_, record_, grad), grad);
    }

   private:
    template <class Found>
    struct VisiblePilots {
        const Value& value;
        const Found& found;

        bool wants(int, Vec2) const { return true; }
        void add(int, const Source& source, const typename Source::Sample& sample) const {
            found(sample.curve, value(source, sample));
        }
    };

    template <class Trace, class Accumulation>
    void add(Trace trace, Accumulation& accumulation, LocalGradients& grad) const {
        Source source = source_;
        CurveSamples samples(view_, source, accumulation);
        trace([&](const typename Source::Curve& point, double weight) {
            if (is_in_view(view_, source.place_of(point))) samples.add(point, 0, weight);
        });
        samples.finish(grad);
    }

    const BackwardView<T>& view_;
    const Source source_;
    const Record& record_;
    const Value value_;
};

struct NoPilots {};

// CurvesOnSurfaces receives all points. append(point, weight, records) records a sample, and value(point, weight) is
// what a pilot finds there. Samplers without pilots need no `value`.
template <class Append, class Value = NoPilots>
class CurvesOnSurfaces {
   public:
    explicit CurvesOnSurfaces(Append append, Value value = {}) : append_(append), value_(value) {}

    template <class Trace, class Found>
    void cast_pilots(Trace trace, Found found) const {
        trace([&](const auto& point, double weight) { found(point, value_(point, weight)); });
    }
    template <class Trace>
    void record(Trace trace, LocalGradients& grad) const {
        trace([&](const auto& point, double weight) { append_(point, weight, grad.records.curves); });
    }

   private:
    const Append append_;
    const Value value_;
};

// SystematicPlaces draws n systematic places on pieces that lie end to end by their measure.
class SystematicPlaces {
   public:
    SystematicPlaces(Array<double> measure, int64_t n, double shift, ThreadTeam& team)
        : measure_(std::move(measure)), systematic_(measure_, team), n_(systematic_.total() > 0 ? n : 0) {
        systematic_.draw(n, shift);
    }
    SystematicPlaces(const SystematicPlaces&) = delete;  // systematic_ refers to measure_.

    int64_t size() const { return n_; }

    // Calls body(i, piece, t, weight) for the places first … last − 1, each at the fraction t of its piece.
    template <class Body>
    void each(int64_t first, int64_t last, Body body) const {
        int64_t k = -1;
        for (int64_t i = first; i < last; ++i) {
            const double position = systematic_.position(i);
            k = k < 0 ? systematic_.primitive(position) : systematic_.primitive(position, k);
            const double t = std::clamp((position - systematic_.begin_of(k)) / systematic_.measure_of(k), 0.0, 1.0);
            body(i, k, t, systematic_.weight(k));
        }
    }

   private:
    Array<double> measure_;
    Systematic systematic_;
    const int64_t n_;
};

}  // namespace edgegrad
