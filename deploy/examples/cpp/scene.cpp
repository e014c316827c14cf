#include "scene.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <optional>
#include <stdexcept>

namespace {

using Place = std::optional<std::array<double, 2>>;  // empty = not known

Place place_of(const Json& json) {
  if (json.is_null()) return {};
  return {{json[0].get<double>(), json[1].get<double>()}};
}

ov::Tensor zeros(const Json& spec, size_t batch) {
  auto shape = spec["shape"];
  shape[0] = batch;  // "B", the only size that is free
  ov::Tensor tensor(spec["type"] == "bool" ? ov::element::boolean : ov::element::f32,
                    shape.get<std::vector<size_t>>());
  std::memset(tensor.data(), 0, tensor.get_byte_size());
  return tensor;
}

// Indices of all agents: the target, then the others by their distance from it now.
std::vector<size_t> nearest(const Json& agents, size_t target) {
  const auto here = *place_of(agents[target].back());
  std::vector<std::pair<double, size_t>> order;
  for (size_t i = 0; i < agents.size(); ++i) {
    const auto there = *place_of(agents[i].back());
    order.emplace_back(std::hypot(there[0] - here[0], there[1] - here[1]), i);
  }
  std::sort(order.begin(), order.end());
  std::vector<size_t> indices;
  for (const auto& [distance, index] : order) indices.push_back(index);
  return indices;
}

// The last `count` places; not known where there are fewer.
std::vector<Place> latest(const Json& history, size_t count) {
  std::vector<Place> places(count);
  const size_t known = std::min(count, history.size());
  for (size_t i = 1; i <= known; ++i) places[count - i] = place_of(history[history.size() - i]);
  return places;
}

// `count` places at equal distances over the whole line.
std::vector<Place> resampled(const Json& line, size_t count) {
  std::vector<Place> places(count);
  const double stride = (line.size() - 1.0) / std::max<size_t>(count - 1, 1);
  for (size_t i = 0; i < count; ++i) {
    const size_t before = std::min<size_t>(i * stride, line.size() - 1);
    const double share = i * stride - before;
    const Place a = place_of(line[before]);
    const Place b = place_of(line[share > 1e-9 ? std::min(before + 1, line.size() - 1) : before]);
    if (a && b) {
      places[i] = {{(*a)[0] + share * ((*b)[0] - (*a)[0]), (*a)[1] + share * ((*b)[1] - (*a)[1])}};
    }
  }
  return places;
}

// Write places, and which of them are known, into row `row` of an input and its mask.
void fill(Inputs& inputs, const std::string& name, size_t row, const std::vector<Place>& places) {
  float* values = inputs.at(name).data<float>() + 2 * row * places.size();
  bool* valid = inputs.at(name + "_valid").data<bool>() + row * places.size();
  for (size_t i = 0; i < places.size(); ++i) {
    if (!places[i]) continue;
    values[2 * i] = static_cast<float>((*places[i])[0]);
    values[2 * i + 1] = static_cast<float>((*places[i])[1]);
    valid[i] = true;
  }
}

}  // namespace

Inputs pack(const Json& scene, const Json& contract) {
  if (std::abs(scene["dt_s"].get<double>() - contract["dt_s"].get<double>()) > 1e-6) {
    throw std::runtime_error("a step of the scene is not as long as the model's");
  }
  const Json& targets = scene["targets"];
  const size_t agents = contract["num_agents"], steps = contract["history_steps"];
  const size_t lines = contract["num_centerlines"], points = contract["centerline_points"];
  Inputs inputs;
  for (const auto& [name, spec] : contract["inputs"].items()) {
    inputs[name] = zeros(spec, targets.size());
  }
  for (size_t b = 0; b < targets.size(); ++b) {
    const auto around = nearest(scene["agents"], targets[b]["agent"]);
    for (size_t n = 0; n < std::min(agents, around.size()); ++n) {
      fill(inputs, "history", b * agents + n, latest(scene["agents"][around[n]], steps));
    }
    const Json& centerlines = targets[b]["centerlines"];
    for (size_t q = 0; q < std::min(lines, centerlines.size()); ++q) {
      fill(inputs, "centerlines", b * lines + q, resampled(centerlines[q], points));
    }
    for (size_t i : {0, 1}) inputs["heading"].data<float>()[2 * b + i] = targets[b]["heading"][i];
  }
  return inputs;
}
