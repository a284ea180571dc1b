// RGB-D odometry on a whole sequence, in one C++ file without a library: each frame is aligned to the last keyframe by
// its brightness (direct alignment, Gauss-Newton with Huber weights).
//
//     c++ -O3 -o odometry odometry.cpp
//     ./odometry settings.yaml SEQUENCE ASSOCIATIONS OUTPUT
//
// settings.yaml has lines "name: number"; SEQUENCE is a folder in TUM layout. odometry.toml describes the program.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <iterator>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

// ---- PNG files: 8-bit colour and 16-bit grey, not interlaced (RFC 1950, 1951 and 2083) ----

// Unpacks deflated data.
class Inflater {
public:
    Inflater(const std::vector<uint8_t>& data, size_t begin) : data_(data), at_(begin) {}

    std::vector<uint8_t> run() {
        bool is_last = false;
        while (!is_last) {
            is_last = bits(1);
            switch (bits(2)) {
                case 0: stored(); break;
                case 1: fixed(); break;
                case 2: dynamic(); break;
                default: throw std::runtime_error("damaged PNG");
            }
        }
        return out_;
    }

private:
    // A Huffman code: how many words there are of each length, and the symbols in the order of their words.
    struct Code {
        std::array<int, 16> count{};
        std::vector<int> symbols;

        explicit Code(const std::vector<int>& lengths) {
            for (int length : lengths) ++count[size_t(length)];
            count[0] = 0;
            for (int length = 1; length < 16; ++length)
                for (size_t symbol = 0; symbol < lengths.size(); ++symbol)
                    if (lengths[symbol] == length) symbols.push_back(int(symbol));
        }
    };

    uint8_t byte() {
        if (at_ >= data_.size()) throw std::runtime_error("truncated PNG");
        return data_[at_++];
    }

    int bits(int count) {
        while (held_ < count) {
            buffer_ |= uint32_t(byte()) << held_;
            held_ += 8;
        }
        const int value = int(buffer_ & ((1u << count) - 1));
        buffer_ >>= count;
        held_ -= count;
        return value;
    }

    int symbol(const Code& code) {
        int word = 0;
        int first = 0;
        int index = 0;
        for (int length = 1; length < 16; ++length) {
            word |= bits(1);
            const int count = code.count[size_t(length)];
            if (word - count < first) return code.symbols.at(size_t(index + word - first));
            index += count;
            first = (first + count) << 1;
            word <<= 1;
        }
        throw std::runtime_error("damaged PNG");
    }

    void stored() {
        buffer_ = 0;
        held_ = 0;
        int length = byte();
        length |= byte() << 8;
        at_ += 2;  // the complement of the length
        while (length-- > 0) out_.push_back(byte());
    }

    void fixed() {
        std::vector<int> lengths(288, 8);
        std::fill(lengths.begin() + 144, lengths.begin() + 256, 9);
        std::fill(lengths.begin() + 256, lengths.begin() + 280, 7);
        block(Code(lengths), Code(std::vector<int>(30, 5)));
    }

    void dynamic() {
        static const int order[19] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
        const int literals = bits(5) + 257;
        const int distances = bits(5) + 1;
        const int codes = bits(4) + 4;
        std::vector<int> first(19, 0);
        for (int i = 0; i < codes; ++i) first[size_t(order[i])] = bits(3);
        const Code code(first);
        std::vector<int> lengths;
        while (int(lengths.size()) < literals + distances) {
            const int next = symbol(code);
            if (next < 16) {
                lengths.push_back(next);
                continue;
            }
            // a length that repeats: the last one, or zero
            const int value = next == 16 ? lengths.back() : 0;
            const int times = next == 16 ? 3 + bits(2) : next == 17 ? 3 + bits(3) : 11 + bits(7);
            lengths.insert(lengths.end(), size_t(times), value);
        }
        const auto middle = lengths.begin() + literals;
        block(Code({lengths.begin(), middle}), Code({middle, lengths.end()}));
    }

    void block(const Code& literals, const Code& distances) {
        static const int length_base[] = {3,  4,  5,  6,  7,  8,  9,  10, 11,  13,  15,  17,  19,  23, 27,
                                          31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258};
        static const int length_bits[] = {0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0};
        static const int distance_base[] = {1,   2,   3,   4,   5,   7,    9,    13,   17,   25,   33,   49,   65,    97,    129,
                                            193, 257, 385, 513, 769, 1025, 1537, 2049, 3073, 4097, 6145, 8193, 12289, 16385, 24577};
        while (true) {
            const int next = symbol(literals);
            if (next == 256) return;
            if (next < 256) {
                out_.push_back(uint8_t(next));
                continue;
            }
            // what stood so far before is repeated
            const int length = length_base[next - 257] + bits(length_bits[next - 257]);
            const int code = symbol(distances);
            const int extra = code < 4 ? 0 : code / 2 - 1;
            const size_t distance = size_t(distance_base[code] + bits(extra));
            if (distance > out_.size()) throw std::runtime_error("damaged PNG");
            for (int i = 0; i < length; ++i) out_.push_back(out_[out_.size() - distance]);
        }
    }

    const std::vector<uint8_t>& data_;
    size_t at_;
    uint32_t buffer_ = 0;
    int held_ = 0;
    std::vector<uint8_t> out_;
};

struct Picture {
    int width = 0;
    int height = 0;
    int channels = 0;
    int bytes = 0;  // of a sample
    std::vector<uint8_t> rows;
};

static Picture read_png(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    const std::vector<uint8_t> data{std::istreambuf_iterator<char>(file), {}};
    if (data.size() < 33) throw std::runtime_error("cannot read " + path);
    const auto number = [&](size_t at) {
        return uint32_t(data[at]) << 24 | uint32_t(data[at + 1]) << 16 | uint32_t(data[at + 2]) << 8 | data[at + 3];
    };

    // size and kind, then all packed data
    Picture picture;
    std::vector<uint8_t> packed;
    for (size_t at = 8; at + 12 <= data.size();) {
        const uint32_t length = number(at);
        const std::string kind(data.begin() + long(at) + 4, data.begin() + long(at) + 8);
        const size_t body = at + 8;
        if (body + length + 4 > data.size()) throw std::runtime_error("truncated " + path);
        if (kind == "IHDR") {
            picture.width = int(number(body));
            picture.height = int(number(body + 4));
            picture.bytes = data[body + 8] / 8;
            picture.channels = data[body + 9] == 2 ? 3 : 1;
        } else if (kind == "IDAT") {
            packed.insert(packed.end(), data.begin() + long(body), data.begin() + long(body + length));
        }
        at = body + length + 4;
    }
    const std::vector<uint8_t> raw = Inflater(packed, 2).run();

    // each row was predicted from its neighbours by one of five filters
    const size_t pixel = size_t(picture.channels * picture.bytes);
    const size_t stride = pixel * size_t(picture.width);
    picture.rows.resize(stride * size_t(picture.height));
    for (size_t y = 0; y < size_t(picture.height); ++y) {
        const uint8_t* from = &raw.at(y * (stride + 1));
        uint8_t* to = &picture.rows[y * stride];
        for (size_t x = 0; x < stride; ++x) {
            const int left = x >= pixel ? to[x - pixel] : 0;
            const int up = y > 0 ? to[long(x) - long(stride)] : 0;
            const int corner = x >= pixel && y > 0 ? to[long(x) - long(stride) - long(pixel)] : 0;
            int guess = 0;
            if (from[0] == 1) guess = left;
            if (from[0] == 2) guess = up;
            if (from[0] == 3) guess = (left + up) / 2;
            if (from[0] == 4) {
                const int sum = left + up - corner;
                const int to_left = std::abs(sum - left);
                const int to_up = std::abs(sum - up);
                const int to_corner = std::abs(sum - corner);
                guess = to_left <= to_up && to_left <= to_corner ? left : to_up <= to_corner ? up : corner;
            }
            to[x] = uint8_t(from[1 + x] + guess);
        }
    }
    return picture;
}

// ---- poses: 4 x 4, row by row ----

using Pose = std::array<double, 16>;
static const Pose IDENTITY{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};

static Pose multiply(const Pose& a, const Pose& b) {
    Pose c{};
    for (size_t i = 0; i < 4; ++i)
        for (size_t j = 0; j < 4; ++j)
            for (size_t k = 0; k < 4; ++k) c[4 * i + j] += a[4 * i + k] * b[4 * k + j];
    return c;
}

static Pose inverse(const Pose& a) {
    Pose c{};
    c[15] = 1;
    for (size_t i = 0; i < 3; ++i)
        for (size_t j = 0; j < 3; ++j) {
            c[4 * i + j] = a[4 * j + i];
            c[4 * i + 3] -= a[4 * j + i] * a[4 * j + 3];
        }
    return c;
}

// The motion of a twist: translation, then rotation vector (Rodrigues); first order in the translation, which is small.
static Pose motion(const double* x) {
    const double angle = std::sqrt(x[3] * x[3] + x[4] * x[4] + x[5] * x[5]);
    const bool turns = angle > 1e-9;
    const double s = turns ? std::sin(angle) / angle : 1;
    const double c = turns ? (1 - std::cos(angle)) / (angle * angle) : 0.5;
    const double w[9] = {0, -x[5], x[4], x[5], 0, -x[3], -x[4], x[3], 0};
    Pose p{1, 0, 0, x[0], 0, 1, 0, x[1], 0, 0, 1, x[2], 0, 0, 0, 1};
    for (size_t i = 0; i < 3; ++i)
        for (size_t j = 0; j < 3; ++j) {
            double square = 0;
            for (size_t k = 0; k < 3; ++k) square += w[3 * i + k] * w[3 * k + j];
            p[4 * i + j] += s * w[3 * i + j] + c * square;
        }
    return p;
}

// x, y, z, w
static std::array<double, 4> quaternion(const Pose& p) {
    const double trace = p[0] + p[5] + p[10];
    if (trace > 0) {
        const double s = 2 * std::sqrt(trace + 1);
        return {(p[9] - p[6]) / s, (p[2] - p[8]) / s, (p[4] - p[1]) / s, s / 4};
    }
    // the largest entry of the diagonal
    const size_t i = p[0] > p[5] ? (p[0] > p[10] ? 0 : 2) : (p[5] > p[10] ? 1 : 2);
    const size_t j = (i + 1) % 3;
    const size_t k = (i + 2) % 3;
    const double s = 2 * std::sqrt(1 + p[5 * i] - p[5 * j] - p[5 * k]);
    std::array<double, 4> q{};
    q[i] = s / 4;
    q[j] = (p[4 * j + i] + p[4 * i + j]) / s;
    q[k] = (p[4 * k + i] + p[4 * i + k]) / s;
    q[3] = (p[4 * k + j] - p[4 * j + k]) / s;
    return q;
}

// ---- images ----

struct Level {  // a grey image with depth, at some fraction of the frame's size
    int width = 0;
    int height = 0;
    double fx = 0;
    double fy = 0;
    double cx = 0;
    double cy = 0;
    std::vector<float> grey;
    std::vector<float> depth;

    float at(double x, double y) const {  // bilinear
        const int u = int(x);
        const int v = int(y);
        const float a = float(x - u);
        const float b = float(y - v);
        const float* p = &grey[size_t(v) * size_t(width) + size_t(u)];
        return (1 - b) * ((1 - a) * p[0] + a * p[1]) + b * ((1 - a) * p[width] + a * p[width + 1]);
    }
};

static Level halved(const Level& big) {
    Level small{big.width / 2, big.height / 2, big.fx / 2, big.fy / 2, (big.cx - 0.5) / 2, (big.cy - 0.5) / 2, {}, {}};
    small.grey.resize(size_t(small.width) * size_t(small.height));
    small.depth.resize(small.grey.size());
    for (int v = 0; v < small.height; ++v)
        for (int u = 0; u < small.width; ++u) {
            float grey = 0;
            float depth = 0;
            int seen = 0;
            for (int k = 0; k < 4; ++k) {
                const size_t from = size_t(2 * v + k / 2) * size_t(big.width) + size_t(2 * u + k % 2);
                grey += big.grey[from] / 4;
                depth += big.depth[from] / 4;
                seen += big.depth[from] > 0;
            }
            const size_t to = size_t(v) * size_t(small.width) + size_t(u);
            small.grey[to] = grey;
            small.depth[to] = seen == 4 ? depth : 0;
        }
    return small;
}

// ---- the odometry ----

using Settings = std::map<std::string, double>;

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
    static const size_t LEVELS = 3;  // from a quarter of the frame's size

    Odometry(double huber, double keyframe_m) : huber_(huber), keyframe_m_(keyframe_m) {}

    // The camera in the world, after this frame; false if it could not be found.
    bool track(const Level& full, Pose& T_world_cam) {
        std::vector<Level> pyramid{halved(halved(full))};
        while (pyramid.size() < LEVELS) pyramid.push_back(halved(pyramid.back()));
        if (key_.empty()) {
            key_ = pyramid;
            T_world_cam = T_world_key_;
            return true;
        }

        // align coarse to fine, beginning with the motion of the frame before
        Pose guess = T_frame_key_;
        double share = 0;
        for (size_t level = LEVELS; level-- > 0;)
            if (!align(key_[level], pyramid[level], guess, share)) return false;
        if (share < 0.3) return false;
        T_frame_key_ = guess;
        T_world_cam = multiply(T_world_key_, inverse(guess));

        // the frame becomes the keyframe where the camera is far from the last one
        const double moved = std::sqrt(guess[3] * guess[3] + guess[7] * guess[7] + guess[11] * guess[11]);
        const double turned = std::acos(std::clamp((guess[0] + guess[5] + guess[10] - 1) / 2, -1.0, 1.0));
        if (moved > keyframe_m_ || turned > keyframe_m_ || share < 0.7) {
            key_ = pyramid;
            T_world_key_ = T_world_cam;
            T_frame_key_ = IDENTITY;
        }
        return true;
    }

private:
    // Gauss-Newton on the brightness of the keyframe's points in the frame, with Huber weights.
    bool align(const Level& key, const Level& now, Pose& T, double& share) const {
        for (int round = 0; round < 12; ++round) {
            double A[6][6] = {};
            double b[6] = {};
            int points = 0;
            int seen = 0;
            for (int v = 1; v < key.height - 1; ++v)
                for (int u = 1; u < key.width - 1; ++u) {
                    const size_t index = size_t(v) * size_t(key.width) + size_t(u);
                    const double z = key.depth[index];
                    if (z <= 0) continue;
                    ++points;

                    // the keyframe's point in the frame
                    const double X = (u - key.cx) / key.fx * z;
                    const double Y = (v - key.cy) / key.fy * z;
                    const double x = T[0] * X + T[1] * Y + T[2] * z + T[3];
                    const double y = T[4] * X + T[5] * Y + T[6] * z + T[7];
                    const double d = T[8] * X + T[9] * Y + T[10] * z + T[11];
                    if (d < 0.1) continue;
                    const double px = now.fx * x / d + now.cx;
                    const double py = now.fy * y / d + now.cy;
                    if (px < 1 || py < 1 || px >= now.width - 2 || py >= now.height - 2) continue;
                    ++seen;

                    // its change of brightness, and how that changes with the motion
                    const double error = now.at(px, py) - key.grey[index];
                    const double gx = (now.at(px + 1, py) - now.at(px - 1, py)) / 2 * now.fx / d;
                    const double gy = (now.at(px, py + 1) - now.at(px, py - 1)) / 2 * now.fy / d;
                    const double gz = -(gx * x + gy * y) / d;
                    const double J[6] = {gx, gy, gz, gz * y - gy * d, gx * d - gz * x, gy * x - gx * y};
                    const double weight = std::abs(error) < huber_ ? 1 : huber_ / std::abs(error);
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

    double huber_;       // grey levels: larger differences count linearly
    double keyframe_m_;  // metres, and radians
    std::vector<Level> key_;
    Pose T_world_key_ = IDENTITY;
    Pose T_frame_key_ = IDENTITY;
};

// ---- the program ----

static Settings read_settings(const std::string& path) {
    std::ifstream file(path);
    if (!file) throw std::runtime_error("cannot read " + path);
    Settings settings;
    for (std::string line; std::getline(file, line);) {
        const size_t colon = line.find(':');
        if (colon == std::string::npos || line[0] == '#') continue;
        settings[line.substr(0, colon)] = std::strtod(line.c_str() + colon + 1, nullptr);
    }
    return settings;
}

static Level read_frame(const std::string& colour, const std::string& range, const Settings& settings) {
    const Picture rgb = read_png(colour);
    const Picture depth = read_png(range);
    if (rgb.channels != 3 || rgb.bytes != 1 || depth.channels != 1 || depth.bytes != 2)
        throw std::runtime_error(colour + " and " + range + " are no 8-bit colour and 16-bit depth");
    Level frame{rgb.width, rgb.height, settings.at("fx"), settings.at("fy"), settings.at("cx"), settings.at("cy"), {}, {}};
    const size_t pixels = size_t(rgb.width) * size_t(rgb.height);
    frame.grey.resize(pixels);
    frame.depth.resize(pixels);
    const double factor = settings.at("depth_factor");
    for (size_t i = 0; i < pixels; ++i) {
        frame.grey[i] = 0.299f * rgb.rows[3 * i] + 0.587f * rgb.rows[3 * i + 1] + 0.114f * rgb.rows[3 * i + 2];
        frame.depth[i] = float((depth.rows[2 * i] << 8 | depth.rows[2 * i + 1]) / factor);
    }
    return frame;
}

static void run(const std::string& settings_file, const std::string& sequence, const std::string& list, const std::string& output) {
    const Settings settings = read_settings(settings_file);
    const double huber = settings.at("huber");
    const double keyframe_m = settings.at("keyframe_m");
    if (huber <= 0 || keyframe_m <= 0) throw std::runtime_error("huber and keyframe_m must be positive");
    Odometry odometry(huber, keyframe_m);

    std::ifstream rows(list);
    std::ofstream poses(output);
    poses.precision(12);
    for (std::string line; std::getline(rows, line);) {
        std::istringstream words(line);
        std::string stamp;
        std::string rgb;
        std::string depth_stamp;
        std::string depth;
        words >> stamp >> rgb >> depth_stamp >> depth;
        Pose p;
        if (!odometry.track(read_frame(sequence + "/" + rgb, sequence + "/" + depth, settings), p)) continue;
        poses << stamp << ' ' << p[3] << ' ' << p[7] << ' ' << p[11];
        for (double value : quaternion(p)) poses << ' ' << value;
        poses << '\n';
    }
}

int main(int count, char** words) {
    try {
        if (count != 5) throw std::runtime_error("odometry SETTINGS SEQUENCE ASSOCIATIONS OUTPUT");
        run(words[1], words[2], words[3], words[4]);
    } catch (const std::exception& error) {
        std::cerr << error.what() << std::endl;
        return 2;
    }
}
