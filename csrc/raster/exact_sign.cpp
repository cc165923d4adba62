#include "raster/exact_sign.h"

namespace edgegrad {

namespace {

struct DoubleDouble {
    double high, low;  // parts of an exact sum
};
DoubleDouble two_sum(double a, double b) {
    const double s = a + b, bb = s - a;
    return {s, (a - (s - bb)) + (b - bb)};
}
DoubleDouble two_product(double a, double b) {
    const double p = a * b;
    return {p, std::fma(a, b, -p)};
}

// Sums doubles without rounding. Its parts do not overlap, the smallest first.
class Expansion {
   public:
    void add(double x) {
        for (int i = 0; i < size_; ++i) {
            const DoubleDouble s = two_sum(x, part_[i]);
            part_[i] = s.low, x = s.high;
        }
        part_[size_++] = x;
    }
    // Adds a b c.
    void add_product(double a, double b, double c) {
        const DoubleDouble ab = two_product(a, b), high = two_product(ab.high, c), low = two_product(ab.low, c);
        add(low.low), add(high.low), add(low.high), add(high.high);
    }
    // Returns the sign of the largest part.
    int sign() const {
        for (int i = size_; i-- > 0;)
            if (part_[i] != 0) return part_[i] > 0 ? 1 : -1;
        return 0;
    }

   private:
    double part_[24];  // Six products of three numbers fit.
    int size_ = 0;
};

}  // namespace

int exact_sign(Vec3 x, Vec3 a, Vec3 b) {
    Expansion sum;
    sum.add_product(a.y, b.z, x.x), sum.add_product(-a.z, b.y, x.x);
    sum.add_product(a.z, b.x, x.y), sum.add_product(-a.x, b.z, x.y);
    sum.add_product(a.x, b.y, x.z), sum.add_product(-a.y, b.x, x.z);
    return sum.sign();
}

int exact_sign(double u, double x, double v, double y) {
    Expansion sum;
    sum.add_product(u, x, 1), sum.add_product(-v, y, 1);
    return sum.sign();
}

int side_of_line(Vec3 p, Vec3 a, Vec3 b) {
    if (const int on = exact_sign(p, a, b)) return on;
    if (const int right = exact_sign(a.y, b.z, a.z, b.y)) return right;
    return exact_sign(a.z, b.x, a.x, b.z);
}

}  // namespace edgegrad
