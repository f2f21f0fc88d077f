#version 430 core
// Triangles without an index: three corners a triangle, so that each knows its barycentrics.
layout(location = 0) in vec3 position;
uniform mat4 view_projection;
out vec3 barycentrics;

void main() {
    int corner = gl_VertexID % 3;
    barycentrics = vec3(corner == 0, corner == 1, corner == 2);
    gl_Position = view_projection * vec4(position, 1.0);
}
