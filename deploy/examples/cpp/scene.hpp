// A scene becomes the model's inputs: tracks and lanes, sized by the model's contract.
#pragma once

#include "model.hpp"

// Scene and contract as read from JSON -> the five inputs. What is not seen stays 0 and false.
Inputs pack(const Json& scene, const Json& contract);
