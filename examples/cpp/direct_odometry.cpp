// A tracker in one C++ file, without a library: direct RGB-D odometry (dense photometric alignment to a keyframe).
//
//     c++ -O3 -march=native -o direct_odometry examples/cpp/direct_odometry.cpp
//     dynslam-bench run "subprocess:./direct_odometry" 'synthetic/sitting_xyz?scene=100' --frames 0:100
//
// It speaks the protocol of docs/how-to/program.md: one JSON object a line on standard input and
// output; the images lie in a file in shared memory. Replace Odometry by your own system; the rest may stay as it is.
#include <fcntl.h>
#include <sys/mman.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <iostream>
#include <string>
#include <vector>

using Pose = std::array<double, 16>;  // 4 x 4, row by row

static Pose multiply(const Pose& a, const Pose& b) {
    Pose c{};
    for (int i = 0; i < 4; ++i)
        for (int j = 0; j < 4; ++j)
            for (int k = 0; k < 4; ++k) c[4 * i + j] += a[4 * i + k] * b[4 * k + j];
    return c;
}

static Pose inverse(const Pose& a) {
    Pose c{};
    c[15] = 1;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            c[4 * i + j] = a[4 * j + i];
            c[4 * i + 3] -= a[4 * j + i] * a[4 * j + 3];
        }
    return c;
}

// The motion of a twist: translation, then rotation vector (Rodrigues); first order in the translation, which is small.
static Pose motion(const double* x) {
    const double angle = std::sqrt(x[3] * x[3] + x[4] * x[4] + x[5] * x[5]);
    const bool turns = angle > 1e-9;
    const double s = turns ? std::sin(angle) / angle : 1, c = turns ? (1 - std::cos(angle)) / (angle * angle) : 0.5;
    const double w[9] = {0, -x[5], x[4], x[5], 0, -x[3], -x[4], x[3], 0};
    Pose p{1, 0, 0, x[0], 0, 1, 0, x[1], 0, 0, 1, x[2], 0, 0, 0, 1};
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            double square = 0;
            for (int k = 0; k < 3; ++k) square += w[3 * i + k] * w[3 * k + j];
            p[4 * i + j] += s * w[3 * i + j] + c * square;
        }
    return p;
}

// A grey image with depth, at some fraction of the frame's size.
struct Level {
    int width = 0, height = 0;
    double fx = 0, fy = 0, cx = 0, cy = 0;
    std::vector<float> grey, depth;

    float at(double x, double y) const {  // bilinear
        const int u = int(x), v = int(y);
        const float a = float(x - u), b = float(y - v), *p = &grey[size_t(v) * width + u];
        return (1 - b) * ((1 - a) * p[0] + a * p[1]) + b * ((1 - a) * p[width] + a * p[width + 1]);
    }
};

static Level halved(const Level& big) {
    Level small{big.width / 2, big.height / 2, big.fx / 2, big.fy / 2, (big.cx - 0.5) / 2, (big.cy - 0.5) / 2, {}, {}};
    small.grey.resize(size_t(small.width) * small.height);
    small.depth.resize(small.grey.size());
    for (int v = 0; v < small.height; ++v)
        for (int u = 0; u < small.width; ++u) {
            float grey = 0, depth = 0;
            int seen = 0;
            for (int k = 0; k < 4; ++k) {
                const size_t from = size_t(2 * v + k / 2) * big.width + 2 * u + k % 2;
                grey += big.grey[from] / 4;
                if (big.depth[from] > 0) depth += big.depth[from], ++seen;
            }
            const size_t to = size_t(v) * small.width + u;
            small.grey[to] = grey;
            small.depth[to] = seen == 4 ? depth / 4 : 0;
        }
    return small;
}

// Solve A x = b for a symmetric positive definite 6 x 6 matrix (Cholesky); false where it is singular.
static bool solve(double A[6][6], double* b) {
    for (int i = 0; i < 6; ++i)
        for (int j = 0; j <= i; ++j) {
            double sum = A[i][j];
            for (int k = 0; k < j; ++k) sum -= A[i][k] * A[j][k];
            if (i == j && sum <= 1e-9) return false;
            A[i][j] = i == j ? std::sqrt(sum) : sum / A[j][j];
        }
    for (int i = 0; i < 6; ++i) {
        for (int k = 0; k < i; ++k) b[i] -= A[i][k] * b[k];
        b[i] /= A[i][i];
    }
    for (int i = 5; i >= 0; --i) {
        for (int k = i + 1; k < 6; ++k) b[i] -= A[k][i] * b[k];
        b[i] /= A[i][i];
    }
    return true;
}

class Odometry {
public:
    // The camera in the world, after this frame; false if it could not be found.
    bool track(const Level& full, Pose& T_world_cam) {
        std::vector<Level> pyramid{halved(full)};
        while (pyramid.size() < 4) pyramid.push_back(halved(pyramid.back()));
        if (key_.empty()) {
            key_ = pyramid;
            T_world_cam = T_world_key_;
            return true;
        }
        Pose guess = T_frame_key_;
        double share = 0;
        for (int level = 3; level >= 0; --level)
            if (!align(key_[level], pyramid[level], guess, share)) return false;
        if (share < 0.3) return false;
        T_frame_key_ = guess;
        T_world_cam = multiply(T_world_key_, inverse(guess));
        const double moved = std::sqrt(guess[3] * guess[3] + guess[7] * guess[7] + guess[11] * guess[11]);
        const double turned = std::acos(std::clamp((guess[0] + guess[5] + guess[10] - 1) / 2, -1.0, 1.0));
        if (moved > 0.1 || turned > 0.1 || share < 0.7) {
            key_ = pyramid;
            T_world_key_ = T_world_cam;
            T_frame_key_ = identity();
        }
        return true;
    }

private:
    static Pose identity() { return {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1}; }

    // Gauss-Newton on the brightness of the keyframe's points in the frame, with Huber weights.
    static bool align(const Level& key, const Level& now, Pose& T, double& share) {
        for (int round = 0; round < 12; ++round) {
            double A[6][6] = {}, b[6] = {};
            int points = 0, seen = 0;
            for (int v = 1; v < key.height - 1; ++v)
                for (int u = 1; u < key.width - 1; ++u) {
                    const double z = key.depth[size_t(v) * key.width + u];
                    if (z <= 0) continue;
                    ++points;
                    const double X = (u - key.cx) / key.fx * z, Y = (v - key.cy) / key.fy * z;
                    const double x = T[0] * X + T[1] * Y + T[2] * z + T[3], y = T[4] * X + T[5] * Y + T[6] * z + T[7],
                                 d = T[8] * X + T[9] * Y + T[10] * z + T[11];
                    if (d < 0.1) continue;
                    const double px = now.fx * x / d + now.cx, py = now.fy * y / d + now.cy;
                    if (px < 1 || py < 1 || px >= now.width - 2 || py >= now.height - 2) continue;
                    ++seen;
                    const double error = now.at(px, py) - key.grey[size_t(v) * key.width + u];
                    const double gx = (now.at(px + 1, py) - now.at(px - 1, py)) / 2 * now.fx / d;
                    const double gy = (now.at(px, py + 1) - now.at(px, py - 1)) / 2 * now.fy / d;
                    const double gz = -(gx * x + gy * y) / d;
                    const double J[6] = {gx, gy, gz, gz * y - gy * d, gx * d - gz * x, gy * x - gx * y};
                    const double weight = std::abs(error) < 8 ? 1 : 8 / std::abs(error);
                    for (int i = 0; i < 6; ++i) {
                        for (int j = 0; j <= i; ++j) A[i][j] += weight * J[i] * J[j];
                        b[i] -= weight * J[i] * error;
                    }
                }
            share = points ? double(seen) / points : 0;
            if (seen < 100 || !solve(A, b)) return false;
            T = multiply(motion(b), T);
            double step = 0;
            for (double value : b) step = std::max(step, std::abs(value));
            if (step < 1e-5) break;
        }
        return true;
    }

    std::vector<Level> key_;
    Pose T_world_key_ = identity(), T_frame_key_ = identity();
};

// The number or the text behind a key of a JSON object whose keys are all different.
static double number(const std::string& line, const char* key) {
    const size_t at = line.find('"' + std::string(key) + "\":");
    return at == std::string::npos ? 0 : std::strtod(line.c_str() + at + std::strlen(key) + 3, nullptr);
}

static std::string text(const std::string& line, const char* key) {
    size_t at = line.find('"' + std::string(key) + "\":");
    if (at == std::string::npos) return "";
    at = line.find('"', at + std::strlen(key) + 3) + 1;
    return line.substr(at, line.find('"', at) - at);
}

int main() {
    Odometry odometry;
    Level frame;
    const uint8_t* memory = nullptr;
    size_t depth_offset = 0;
    for (std::string line; std::getline(std::cin, line);) {
        const std::string op = text(line, "op");
        if (op == "reset") {
            frame.width = int(number(line, "width"));
            frame.height = int(number(line, "height"));
            frame.fx = number(line, "fx"), frame.fy = number(line, "fy");
            frame.cx = number(line, "cx"), frame.cy = number(line, "cy");
            frame.grey.resize(size_t(frame.width) * frame.height);
            frame.depth.resize(frame.grey.size());
            depth_offset = size_t(number(line, "depth_offset"));
            const int file = open(text(line, "file").c_str(), O_RDONLY);
            void* mapped = mmap(nullptr, size_t(number(line, "bytes")), PROT_READ, MAP_SHARED, file, 0);
            if (file < 0 || mapped == MAP_FAILED) {
                std::cout << R"({"error": "cannot map the images"})" << std::endl;
                return 1;
            }
            memory = static_cast<const uint8_t*>(mapped);
            std::cout << R"({"ok": true})" << std::endl;
        } else if (op == "track") {
            const uint8_t* rgb = memory;
            for (float& grey : frame.grey) {
                grey = 0.299f * rgb[0] + 0.587f * rgb[1] + 0.114f * rgb[2];
                rgb += 3;
            }
            std::memcpy(frame.depth.data(), memory + depth_offset, frame.depth.size() * sizeof(float));
            Pose pose;
            const auto begin = std::chrono::steady_clock::now();
            const bool found = odometry.track(frame, pose);
            const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - begin;
            const int index = int(number(line, "index"));
            std::printf("{\"index\": %d, \"state\": \"%s\", \"T_world_cam\": ", index, found ? "ok" : "lost");
            if (!found) std::printf("null");
            for (int i = 0; found && i < 16; ++i) std::printf("%c%.17g", i ? ',' : '[', pose[size_t(i)]);
            std::printf("%s, \"timings\": {\"odometry\": %.6f}}\n", found ? "]" : "", seconds.count());
            std::fflush(stdout);
        } else {
            break;
        }
    }
}
