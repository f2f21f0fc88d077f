#version 430 core
// The visibility buffer: which triangle (counted from 1, exact below 2^24) and where on it.
in vec3 barycentrics;
uniform int first_triangle;
layout(location = 0) out vec4 seen;

void main() {
    seen = vec4(float(first_triangle + gl_PrimitiveID + 1), barycentrics);
}
