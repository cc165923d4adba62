// Large arrays: how they come to memory, and from there.
#pragma once

#include <algorithm>
#include <cstdint>
#include <memory>
#include <type_traits>

#if defined(__linux__)
#include <sys/mman.h>
#endif

#include "core/parallel.h"

namespace edgegrad {

// Asks for what will be read soon.
inline void prefetch(const void* p) {
#if defined(__GNUC__)
    __builtin_prefetch(p);
#endif
}

// The same of n elements from p on, which may lie in two lines of the cache.
template <class T>
void prefetch_all(const T* p, int64_t n) {
    prefetch(p), prefetch(reinterpret_cast<const char*>(p + n) - 1);
}

// Asks Linux for large pages, as NumPy does: memory of this size is fetched from the system anew each time, and by
// small pages that takes as long as all that is then written to it.
inline void prefer_large_pages([[maybe_unused]] void* p, [[maybe_unused]] size_t bytes) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
    constexpr uintptr_t page = 1 << 12, least = 1 << 22;
    if (bytes < least) return;
    const uintptr_t begin = (reinterpret_cast<uintptr_t>(p) + page - 1) & ~(page - 1);
    madvise(reinterpret_cast<void*>(begin), reinterpret_cast<uintptr_t>(p) + bytes - begin, MADV_HUGEPAGE);
#endif
}

// An array of which every element will be written before it is read, by several threads. Unlike std::vector it sets
// nothing to zero: one thread would do that, and fetch the pages from the system, while the others wait. Memory comes
// from the one that writes it first.
template <class T>
class Array {
   public:
    static_assert(std::is_trivially_copyable_v<T> && std::is_trivially_destructible_v<T>);

    explicit Array(int64_t n) : data_(static_cast<T*>(::operator new(n * sizeof(T)))), size_(n) {
        prefer_large_pages(data_.get(), n * sizeof(T));
    }

    T& operator[](int64_t i) { return data_.get()[i]; }
    const T& operator[](int64_t i) const { return data_.get()[i]; }
    T* data() { return data_.get(); }
    const T* data() const { return data_.get(); }
    T* begin() { return data_.get(); }
    T* end() { return data_.get() + size_; }
    const T* begin() const { return data_.get(); }
    const T* end() const { return data_.get() + size_; }
    int64_t size() const { return size_; }
    bool empty() const { return size_ == 0; }
    T& back() { return data_.get()[size_ - 1]; }
    const T& back() const { return data_.get()[size_ - 1]; }

   private:
    struct Free {
        void operator()(T* p) const { ::operator delete(p); }
    };
    std::unique_ptr<T, Free> data_;
    int64_t size_;
};

template <class T = double>
Array<T> zeros(int64_t n, ThreadTeam& team) {
    Array<T> a(n);
    team.parallel_for_blocks(
        n, [&](int64_t, int64_t first, int64_t last) { std::fill(a.begin() + first, a.begin() + last, T(0)); });
    return a;
}

inline Array<float> to_float(const Array<double>& values, ThreadTeam& team) {
    Array<float> a(values.size());
    team.parallel_for_blocks(a.size(), [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i) a[i] = float(values[i]);
    });
    return a;
}

}  // namespace edgegrad
