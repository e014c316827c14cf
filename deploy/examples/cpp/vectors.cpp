#include "vectors.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <iterator>
#include <limits>
#include <stdexcept>

namespace {

namespace fs = std::filesystem;

constexpr double kLimitM = 1e-3;  // how far a position may be from the stored one
constexpr double kProbability = 1e-4;
constexpr double kCovariance = 1e-3;  // as a share of the largest, or of 1 m^2

// Reads a protocol buffer, piece by piece.
class Reader {
 public:
  explicit Reader(std::string bytes) : bytes_(std::move(bytes)) {}

  bool more() const { return at_ < bytes_.size(); }

  uint64_t varint() {
    uint64_t value = 0;
    for (int shift = 0; shift < 64; shift += 7) {
      const auto byte = static_cast<uint8_t>(bytes_.at(at_++));
      value |= uint64_t{byte & 0x7fu} << shift;
      if (byte < 0x80) return value;
    }
    throw std::runtime_error("not a protocol buffer");
  }

  std::string bytes(size_t count) {
    if (count > bytes_.size() - at_) throw std::runtime_error("a protocol buffer that was cut");
    at_ += count;
    return bytes_.substr(at_ - count, count);
  }

 private:
  std::string bytes_;
  size_t at_ = 0;
};

// A serialised TensorProto of float32 or bool: dims (field 1), data_type (2), raw_data (9).
ov::Tensor read_tensor(const fs::path& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error(path.string() + ": cannot be read");
  Reader reader(std::string(std::istreambuf_iterator<char>(file), {}));
  ov::Shape shape;
  uint64_t kind = 0;
  std::string raw;
  while (reader.more()) {
    const uint64_t key = reader.varint(), value = reader.varint();  // of bytes, their number
    const std::string bytes = (key & 7) == 2 ? reader.bytes(value) : "";
    if (key == (1 << 3)) shape.push_back(value);
    if (key == (1 << 3 | 2)) {
      for (Reader packed(bytes); packed.more();) shape.push_back(packed.varint());
    }
    if (key == (2 << 3)) kind = value;
    if (key == (9 << 3 | 2)) raw = bytes;
  }
  if (kind != 1 && kind != 9) throw std::runtime_error(path.string() + ": not float32 or bool");
  ov::Tensor tensor(kind == 1 ? ov::element::f32 : ov::element::boolean, shape);
  if (raw.size() != tensor.get_byte_size()) throw std::runtime_error(path.string() + ": was cut");
  std::memcpy(tensor.data(), raw.data(), raw.size());
  return tensor;
}

// The largest between two modes; of a covariance as a share of its largest value or of 1 m^2.
double difference(const ov::Tensor& found, size_t found_mode, const ov::Tensor& expected,
                  size_t expected_mode) {
  const ov::Shape& shape = expected.get_shape();
  const size_t size = expected.get_size() / (shape[0] * shape[1]);
  const size_t unit = shape.size() == 5 ? 4 : 1;  // values of one covariance
  const float* mine = found.data<float>() + found_mode * size;
  const float* theirs = expected.data<float>() + expected_mode * size;
  double largest = 0.0;
  for (size_t i = 0; i < size; i += unit) {
    double scale = 1.0;
    for (size_t j = i; unit > 1 && j < i + unit; ++j) {
      scale = std::max<double>(scale, std::abs(theirs[j]));
    }
    for (size_t j = i; j < i + unit; ++j) {
      largest = std::max(largest, std::abs(double{mine[j]} - theirs[j]) / scale);
    }
  }
  return largest;
}

bool finite(const ov::Tensor& tensor) {
  const float* values = tensor.data<float>();
  return std::all_of(values, values + tensor.get_size(), [](float v) { return std::isfinite(v); });
}

// How far positions are apart, and whether all outputs agree.
struct Comparison {
  double worst_m = 0.0;
  bool good = true;
};

// Modes that are as probable as each other may change places.
Comparison compare(const Outputs& found, const Outputs& expected) {
  for (size_t i = 0; i < expected.size(); ++i) {
    if (found[i].get_shape() != expected[i].get_shape() || !finite(found[i]) ||
        !finite(expected[i])) {
      return {std::numeric_limits<double>::infinity(), false};
    }
  }
  Comparison result;
  const size_t batch = expected[1].get_shape()[0], modes = expected[1].get_shape()[1];
  const float *mine = found[1].data<float>(), *theirs = expected[1].data<float>();
  for (size_t b = 0; b < batch; ++b) {
    std::vector<bool> taken(modes);
    for (size_t k = b * modes; k < (b + 1) * modes; ++k) {
      size_t mode = k;
      double apart = std::numeric_limits<double>::infinity();
      for (size_t m = b * modes; m < (b + 1) * modes; ++m) {
        if (taken[m - b * modes] || std::abs(mine[m] - theirs[k]) > kProbability) continue;
        const double here = difference(found[0], m, expected[0], k);
        if (here < apart) {
          mode = m;
          apart = here;
        }
      }
      taken[mode - b * modes] = true;
      result.good = result.good && std::isfinite(apart);
      result.worst_m = std::max(result.worst_m, difference(found[0], mode, expected[0], k));
      for (size_t i = 2; i < expected.size(); ++i) {
        result.good = result.good && difference(found[i], mode, expected[i], k) <= kCovariance;
      }
    }
  }
  result.good = result.good && result.worst_m <= kLimitM;
  return result;
}

Outputs read_all(const fs::path& folder, const std::string& side, size_t count) {
  Outputs tensors;
  for (size_t i = 0; i < count; ++i) {
    tensors.push_back(read_tensor(folder / (side + "_" + std::to_string(i) + ".pb")));
  }
  return tensors;
}

}  // namespace

bool check(const fs::path& artifact, const Json& contract, const Run& run) {
  Comparison all;
  size_t count = 0;
  for (const auto& entry : fs::directory_iterator(artifact)) {
    if (entry.path().filename().string().rfind("test_data_set_", 0) != 0) continue;
    const Outputs stored = read_all(entry, "input", contract["inputs"].size());
    Inputs inputs;
    size_t index = 0;
    for (const auto& [name, spec] : contract["inputs"].items()) inputs[name] = stored[index++];
    const Outputs expected = read_all(entry, "output", contract["outputs"].size());
    const Comparison result = compare(run(inputs), expected);
    all = {std::max(all.worst_m, result.worst_m), all.good && result.good};
    ++count;
  }
  all.good = all.good && count > 0;
  std::printf("%s: %zu vectors, worst %.4f mm, %s\n", contract["name"].get<std::string>().c_str(),
              count, 1e3 * all.worst_m, all.good ? "ok" : "FAILED");
  return all.good;
}
