// What a model reads and gives: tensors by the names in its contract.
#pragma once

#include <map>
#include <nlohmann/json.hpp>
#include <openvino/runtime/tensor.hpp>
#include <string>
#include <vector>

using Json = nlohmann::ordered_json;  // the contract's tensors are in order
using Inputs = std::map<std::string, ov::Tensor>;
using Outputs = std::vector<ov::Tensor>;  // in the contract's order, trajectories first
